"""Every command on a page of docs/ has its options, runs, and prints what the page shows.

A page's `console` blocks are one session in a new folder. In the shown output `...` stands for any
text, and white space does not count. A block after `<!-- not run: REASON -->` needs what a test
machine lacks.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import pytest

from cangauge.cli.app import load_command
from selection import nightly_except

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(
    r"(?P<skip><!-- not run: [^>]+ -->\n[ ]*)?```console\n(?P<text>.*?)\n[ ]*```", re.DOTALL
)
PAGES = sorted(
    path.relative_to(DOCS).as_posix()
    for path in DOCS.rglob("*.md")
    if "```console" in path.read_text(encoding="utf-8")
)


@dataclass
class Step:
    command: str
    shown: str


def steps(page: str, *, everywhere: bool = True) -> list[Step]:
    """The commands of a page, or those that run everywhere, each with the output shown."""
    found: list[Step] = []
    for block in BLOCK.finditer((DOCS / page).read_text(encoding="utf-8")):
        if block["skip"] and everywhere:
            continue
        indent = re.search(rf"^([ ]*){re.escape(block['text'].split()[0])}", block["text"])
        text = textwrap.dedent(block["text"]) if indent else block["text"]
        for line in text.splitlines():
            if line.startswith("$ "):
                found.append(Step(line[2:], ""))
            elif line.startswith("> "):
                found[-1].command += "\n" + line[2:]
            else:
                found[-1].shown += line + "\n"
    return found


IN_SUITE = ("init.md",)
"""Pages that run on every change; the others run in `make nightly`."""


@pytest.mark.parametrize("page", nightly_except(IN_SUITE, PAGES))
def test_commands_print_what_the_page_shows(page: str, tmp_path: Path) -> None:
    session = steps(page)
    if not session:
        pytest.skip("no command of this page runs without further hardware or services")
    script = ["set -u"]
    for number, step in enumerate(session):
        script += [f"{{ {step.command}\n}} > .out{number} 2>&1", f"echo $? > .rc{number}"]
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "140",
        "NO_COLOR": "1",
    }
    subprocess.run(
        ["bash", "-c", "\n".join(script)], cwd=tmp_path, env=environment, check=True, timeout=240,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    for number, step in enumerate(session):
        output = (tmp_path / f".out{number}").read_text(encoding="utf-8")
        code = int((tmp_path / f".rc{number}").read_text())
        assert code in (0, 143), f"{step.command}\n{output}"  # 143: `wait` for a stopped service
        assert matches(step.shown, output), f"{step.command}\nshown:\n{step.shown}\ngot:\n{output}"


def matches(shown: str, output: str) -> bool:
    """Whether an output is as shown; nothing shown: it may be anything."""
    if not shown:
        return True
    parts = [re.escape("".join(part.split())) for part in shown.split("...")]
    return re.fullmatch(".*".join(parts), "".join(output.split()), re.DOTALL) is not None


@pytest.mark.parametrize("page", PAGES)
def test_commands_of_the_page_have_these_options(page: str) -> None:
    for step in steps(page, everywhere=False):
        own = re.sub(r"\$\(.*?\)\"", "", step.command)  # what another program prints
        for name, rest in re.findall(r"\bcangauge ([a-z-]+)([^|;&>]*)", own):
            command = load_command(name)
            used = {each.partition("=")[0] for each in rest.split() if re.match("--?[a-z]", each)}
            for part in getattr(command, "commands", {}).values():
                command = part if part.name == rest.split()[0] else command
            known = {each for parameter in command.params for each in parameter.opts}
            assert used <= known | {"--help"}, step.command


def test_each_page_is_in_the_navigation() -> None:
    navigation = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    for path in DOCS.rglob("*.md"):
        assert f": {path.relative_to(DOCS).as_posix()}" in navigation


@pytest.mark.parametrize("page", ["SECURITY.md", "docs/threat-model.md", "docs/service.md"])
def test_each_promise_names_a_test_that_exists(page: str) -> None:
    text = (DOCS.parent / page).read_text(encoding="utf-8")
    named = re.findall(r"`((?:tests|benchmarks)/[\w/.]+)`", text)
    assert named
    assert [path for path in named if not (DOCS.parent / path).exists()] == []
    for table in re.findall(r"\| test \|\n\|[-|]+\|\n((?:\|.*\n?)+)", text):
        for row in table.splitlines():
            assert "`tests/" in row.rsplit("|", 2)[1], row
