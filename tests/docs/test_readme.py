"""README's Python example runs, without pandas."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

import cangauge
from cangauge.logs.canonical import write_log


def test_python_example_runs_without_pandas(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    text = (project / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = ("trip1", "trip2", "trip3", "trip4", "today")
    for number, name in enumerate(names, start=1):
        log = cangauge.simulate(seed=3, drive=number, hours=1.0).log
        write_log(log, tmp_path / f"{name}.csv")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pandas", None)
    exec(compile(example, "README.md", "exec"), {})  # noqa: S102 - our own page
    assert re.match(r"SoC \d+\.\d ± \d+\.\d %\n", capsys.readouterr().out)
    assert (tmp_path / "pack.json").is_file()
