"""README's Python example runs, its commands exist, and its figures are the kept ones."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

import cangauge
from cangauge.cli.app import COMMANDS, load_command
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


def test_each_command_takes_the_options_that_are_shown(project: Path) -> None:
    text = (project / "README.md").read_text(encoding="utf-8")
    shown = re.findall(rf"cangauge ((?:{'|'.join(COMMANDS)}) [^`\n]*)", text)
    assert len(shown) > 20
    for line in shown:
        name, *given = shlex.split(line.split("&&")[0])
        known = {option for each in load_command(name).params for option in each.opts}
        assert {word for word in given if word.startswith("-") and word != "--"} <= known, line


@pytest.fixture(scope="module")
def kept(project: Path) -> Any:
    """First cells and the others of each row of kept figures, by name."""

    def table(name: str, number: int) -> dict[tuple[str, ...], dict[str, str]]:
        path = project / "benchmarks" / "figures" / f"{name}.json"
        content = json.loads(path.read_text(encoding="utf-8"))["tables"][number]
        rows = [dict(zip(content["columns"], row, strict=True)) for row in content["rows"]]
        return {tuple([*row.values()][:2]): row for row in rows}

    return table


def test_key_figures_are_the_kept_ones(project: Path, kept: Any) -> None:
    text = (project / "README.md").read_text(encoding="utf-8")
    packs = kept("packs-cangauge", 1)
    threes = [packs[name, "3"]["withheld"] for name in ("i3", "car1", "lg_hg2", "a123_lfp")]
    assert f"| {'; '.join(threes)} % |" in text
    whole = next(row for row in kept("packs-cangauge", 0).values() if row["case"] == "withheld")
    assert f"| {whole['astray']} |" in text
    assert f"| {whole['rows with 2σ ≥ 88 %']} |" in text
