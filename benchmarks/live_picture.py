"""Record the animated picture of the README: the live page while a log plays.

    python benchmarks/live_picture.py [-o docs/live.gif] [--seconds 20]

Plays the shipped log on a bus of this script only, as fast as the service acknowledges, and takes
pictures of the page in headless Chromium.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from PIL import Image

from cangauge._resources import shared_file
from cangauge.bus.open import bus_address
from cangauge.bus.recording import read_log
from cangauge.extras.report.charts import AMBER, BLUE, GREEN, ORANGE
from cangauge.identify.fit import fit
from live_page import PAGE_PORT, chromium
from live_service import command, service

BUS: Final = bus_address("udp_multicast", "239.74.163.93", {"port": 43_563})
TRAINED_ON: Final = shared_file("replay", "leaf2012_reconstruction_white.parquet")
LOG: Final = shared_file("replay", "leaf2012_reconstruction_correlated.parquet")
EVERY_S: Final = 0.25
SIZE: Final = (1264, 826)
"""Part of the page in the picture [px]: values, SoC and status."""
SHOWN: Final = (900, 588)
COLOURS: Final = 48
PICTURES: Final = 50
"""Most pictures kept: with more the file grows beyond 1.5 MB."""


def pictures(browser: Any) -> list[Image.Image]:
    """Play the log at full speed; return a picture of the page every `EVERY_S` meanwhile."""
    found: list[Image.Image] = []
    process = subprocess.Popen(
        command(BUS, "replay", LOG, "--speed", "max"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    began = time.monotonic()
    while process.poll() is None:
        picture = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        found.append(picture.crop((0, 0, *SIZE)).resize(SHOWN, Image.Resampling.LANCZOS))
        time.sleep(max(began + EVERY_S * len(found) - time.monotonic(), 0.0))
    return found


def main() -> None:
    """Record and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/live.gif"))
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    arguments = ("--time-source", "replay-clock", "--status-socket", "off")
    page = ("--dashboard", str(PAGE_PORT))
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.json"  # as in `cangauge demo`
        fit([read_log(TRAINED_ON)], equation="published").model.save(model)
        of_model = ("--model", str(model))
        with service(BUS, *arguments, *page, *of_model), chromium(PAGE_PORT) as browser:
            browser.set_window_size(SIZE[0], 1200)
            found = pictures(browser)
    found = found[:: -(-len(found) // PICTURES)]
    # One palette for all pictures: what does not change costs nothing then.
    sample = found[-1].copy()
    for place, colour in enumerate((BLUE, ORANGE, GREEN, AMBER)):  # thin lines would lose theirs
        sample.paste(colour, (0, 20 * place, 200, 20 * place + 20))
    palette = sample.quantize(COLOURS)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in found]
    duration_ms = round(1e3 * given.seconds / len(frames))
    frames[0].save(
        given.output, save_all=True, append_images=frames[1:], duration=duration_ms, loop=0,
        optimize=True,
    )  # fmt: skip
    sys.stdout.write(f"{given.output}: {len(frames)} pictures, {given.output.stat().st_size} B\n")


if __name__ == "__main__":
    main()
