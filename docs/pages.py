"""The pages of the site: the pages of this folder, and pages made from the code.

    python docs/pages.py out/docs

The pages of commands, configuration, frames and effects are made from the code. They are not
committed, so they cannot differ from it. `make site` calls this program, and builds the site.
"""

from __future__ import annotations

import html
import inspect
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import typer

from cangauge import simulate
from cangauge.bus.publish import reason_bits
from cangauge.cli.app import COMMANDS, load_command
from cangauge.model.effects.library import LIBRARY
from cangauge.service.config import reference
from cangauge.types import REASON_WORDS, reason_name

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
from figures import with_figures  # noqa: E402 - a module beside the package

OUTSIDE_LINK = re.compile(
    r"\[([^\]]*)\]\((?:\.\./)+(?:src|dbc|replay|contrib|examples|benchmarks|tests|[A-Z]+\.md)[^)]*\)"
)
"""A link to a file of the repository that is no page of the site."""

# A drive of half an hour with stops, regeneration and a rest.
DRIVE: dict[str, Any] = {"seed": 4, "drive": 3, "hours": 0.5, "pack": "leaf40"}


def write_pages(folder: Path) -> None:
    """Write all pages into a folder, anew."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(
        ROOT / "docs", folder, ignore=shutil.ignore_patterns("*.py", "*.sh", "__pycache__")
    )
    for path, text in (
        ("reference/commands.md", commands_page()),
        ("reference/configuration.md", configuration_page()),
        ("reference/frames.md", frames_page()),
        ("explanation/effects.md", effects_page()),
    ):
        target = folder / path
        target.parent.mkdir(exist_ok=True)
        target.write_text(text, encoding="utf-8")
    for page in folder.rglob("*.md"):  # the site does not hold the files of the repository
        text = with_figures(page.read_text(encoding="utf-8"))
        page.write_text(OUTSIDE_LINK.sub(r"\1", text), encoding="utf-8")


def commands_page() -> str:
    """Return the reference of the commands, from their help."""
    parts = [
        "# Commands",
        "`cangauge COMMAND -h` prints the text below. With `--json`, every command except `live`"
        " prints one JSON object on stdout. Exit codes: 0 done, 1 failed, 2 bad usage or input,"
        " 130 stopped by Ctrl-C.",
    ]
    for name in COMMANDS:
        command = load_command(name)
        text = inspect.cleandoc(command.help or "")
        text = re.sub(r"^#+ (.+)$", r"**\1**", text, flags=re.MULTILINE)
        parts += [f"## cangauge {name}", text]
        rows = ["| Option | Value | Default | Meaning |", "| --- | --- | --- | --- |"]
        context = typer.Context(command, info_name=name)
        rows.extend(_option_row(parameter) for parameter in command.get_params(context))
        parts.append("\n".join(rows))
    return "\n\n".join(parts) + "\n"


def configuration_page() -> str:
    """Return the reference of the service's configuration."""
    text = (
        "# Configuration of the service\n\nThe table lists the keys of `cangauge run --config"
        " FILE.toml`, and the option that overrides each key. A path in the file is relative to"
        " the file.\n\n"
    )
    return text + reference()


def _option_row(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        metavar = (parameter.metavar or parameter.name).upper()
        names, value = f"`{metavar}`", "one or more" if parameter.nargs != 1 else ""
        if parameter.required:
            value = f"{value}, required".lstrip(", ")
    else:
        names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
        value = "" if parameter.is_flag else str(parameter.metavar or "").strip("<>")
    default = parameter.default
    shown = "" if default in (None, False, (), []) or parameter.required else str(default)
    text = " ".join((getattr(parameter, "help", "") or "").split())
    return "| " + " | ".join(_cell(each) for each in (names, value, shown, text)) + " |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def frames_page() -> str:
    """Return the reference of the published frames, from their DBC."""
    database = cantools.database.load_file(ROOT / "dbc" / "soc_estimate.dbc")
    parts = [
        "# Frames",
        "The service publishes these frames, except the replay clock, which `cangauge replay`"
        " sends. `dbc/soc_estimate.dbc` defines them.",
    ]
    parts.append(_comment())
    for message in sorted(database.messages, key=lambda each: each.frame_id):
        period = f", every {message.cycle_time} ms" if message.cycle_time else ""
        parts += [
            f"## {message.name} 0x{message.frame_id:X}{period}",
            str(message.comment or ""),
        ]
        rows = [
            "| Signal | Start bit | Bits | Step | Range | Unit | Meaning |",
            "| --- | --- | --- | --- | --- | --- | --- |",
        ]
        for signal in message.signals:
            limits = f"{signal.minimum:.9g} … {signal.maximum:.9g}"
            cells = (
                f"`{signal.name}`", f"{signal.start}", f"{signal.length}", f"{signal.scale:g}",
                limits, signal.unit or "",
                "See Reasons below." if signal.name == "reason" else str(signal.comment or ""),
            )  # fmt: skip
            rows.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
        parts.append("\n".join(rows))
    bits = {each: int(reason_bits(each)).bit_length() - 1 for each in REASON_WORDS}
    rows = ["| Bit | Reason | Meaning |", "| --- | --- | --- |"]
    rows += [
        f"| {bits[reason]} | {reason_name(reason)} | {_cell(REASON_WORDS[reason])} |"
        for reason in sorted(bits, key=bits.__getitem__)
    ]
    about = "A bit of `reason` is 1 while one of its reasons applies."
    parts += ["## Reasons", about, "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def _comment() -> str:
    """Return the comment on the whole database, which cantools does not keep."""
    text = (ROOT / "dbc" / "soc_estimate.dbc").read_text(encoding="utf-8")
    found = re.search(r'^CM_ "([^"]*)";', text, re.MULTILINE)
    return found.group(1) if found else ""


def effects_page() -> str:
    """Return the effects with equation, source, and a drawing of the voltage that each adds."""
    parts = [
        "# The effects and their signatures",
        "An effect changes the difference between measured and modelled voltage. The pattern of"
        " this change is the signature of the effect. Each drawing shows half an hour of the"
        " same simulated drive. The upper curve is the current (discharge upwards). The lower"
        " curve is the voltage that the effect adds, without sensor noise. `cangauge twin"
        " --effect ID` simulates an effect, and `cangauge gap` searches for it.",
    ]
    fault = ""
    for effect in sorted(LIBRARY.values(), key=lambda each: (each.fault, each.id)):
        if effect.fault != fault:
            fault = effect.fault
            parts.append(f"## {fault.replace('_', ' ').capitalize()}")
        parts += [
            f"### {effect.id}",
            f"```text\n{effect.equation}\n```",
            inspect.cleandoc(effect.about),
            signature_svg(effect.id),
        ]
    return "\n\n".join(parts) + "\n"


def signature_svg(effect_id: str) -> str:
    """Return a drawing of the current and of the gap that an effect opens, as SVG."""
    recording = simulate(f"{effect_id}:gap_v=1.0", **DRIVE).recording
    minutes = recording.log.time_s / 60.0
    width, upper, lower, left = 640, 60, 110, 56
    step = max(1, minutes.size // 900)
    parts = [
        f'<svg viewBox="0 0 {width} {upper + lower + 44}" role="img" class="signature"'
        f' aria-label="Voltage that {html.escape(effect_id)} adds during a drive"'
        ' style="max-width:100%;font:11px sans-serif" fill="currentColor">'
    ]
    for top, height, values, unit, colour in (
        (6, upper, recording.log.current_a, "A", "#7a7a7a"),
        (upper + 18, lower, recording.gap_v, "V", "#0072b2"),
    ):
        low, high = min(0.0, float(np.min(values))), max(0.0, float(np.max(values)))
        span = (high - low) or 1.0
        x = left + (width - left - 8) * minutes[::step] / float(minutes[-1])
        y = top + height * (high - values[::step]) / span
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        zero = top + height * high / span
        parts += [
            f'<line x1="{left}" x2="{width - 8}" y1="{zero:.1f}" y2="{zero:.1f}"'
            ' stroke="currentColor" stroke-opacity=".35"/>',
            f'<polyline fill="none" stroke="{colour}" stroke-width="1.2" points="{points}"/>',
            f'<text x="{left - 6}" y="{top + 9}" text-anchor="end">{high:.3g} {unit}</text>',
            f'<text x="{left - 6}" y="{top + height}" text-anchor="end">{low:.3g} {unit}</text>',
        ]
    bottom = upper + lower + 36
    for minute in range(0, int(minutes[-1]) + 1, 10):
        at = left + (width - left - 8) * minute / float(minutes[-1])
        parts.append(f'<text x="{at:.0f}" y="{bottom}" text-anchor="middle">{minute} min</text>')
    parts.append("</svg>")
    return "".join(parts)


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
