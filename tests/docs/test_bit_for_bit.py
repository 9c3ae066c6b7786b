"""The keys of the service that `estimate` cannot be told are named beside the promise."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from cangauge.cli.estimate import estimate_command
from cangauge.cli.options import ReadingOptions
from cangauge.service.setup import load_vehicle, pipeline_settings


def test_what_estimate_has_no_option_for_is_named(project: Path) -> None:
    source = inspect.getsource(pipeline_settings) + inspect.getsource(load_vehicle)
    used = set(re.findall(r"config\.(\w+)", source)) - {"vehicle", "dbc", "map", "time_source"}
    told = {*inspect.signature(estimate_command).parameters, *ReadingOptions.__dataclass_fields__}
    text = (project / "docs" / "service.md").read_text()
    promise = text[text.index("estimates bit for bit, if") :]
    named = set(re.findall(r"`\[?([a-z_]+)(?:\.replay_clock)?\]?`", promise[:400]))
    assert used - told <= named
