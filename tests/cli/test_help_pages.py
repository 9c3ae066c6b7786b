"""Help pages: quick, since they import nothing that computes, and true to what they repeat."""

from __future__ import annotations

import json
import subprocess
import sys

from cangauge.cli import options
from cangauge.cli.app import COMMANDS
from cangauge.diagnosis import ALARM

SLOW_TO_IMPORT = {
    "numpy", "scipy", "pandas", "pyarrow", "bokeh", "matplotlib", "clarabel", "can", "cantools",
    "dask", "distributed", "jinja2", "asyncio", "multiprocessing", "concurrent",
    "filterpy", "cangauge.service.run", "cangauge.bus", "cangauge.model",
    "cangauge.estimation", "cangauge.diagnosis",
}  # fmt: skip
ALL_PAGES = """
import contextlib, io, json, sys
from cangauge.cli.app import main
slow, found = json.loads(sys.argv[1])
for words in json.loads(sys.argv[2]):
    sys.argv = ["cangauge", *words, "--help"]
    page = io.StringIO()
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
        main()
    assert "Usage: " + " ".join(["cangauge", *words]) in page.getvalue(), page.getvalue()
    found[" ".join(words)] = sorted(set(slow) & set(sys.modules))
print(json.dumps(found))
"""


def test_no_help_page_imports_what_computes() -> None:
    names = list(COMMANDS)
    pages = [[], *([name] for name in names)]
    given = json.dumps([sorted(SLOW_TO_IMPORT), {}]), json.dumps(pages)
    done = subprocess.run(
        [sys.executable, "-c", ALL_PAGES, *given],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert {page: names for page, names in found.items() if names} == {}
    assert len(found) == len(names) + 1


def test_help_pages_repeat_the_probability_of_an_alarm_truly() -> None:
    assert options.ALARM == ALARM
