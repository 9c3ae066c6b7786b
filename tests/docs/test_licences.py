"""Each package and DBC file has its licence stated."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path


def names(requirements: list[str]) -> set[str]:
    found = {re.split(r"[\[><=; ]", each)[0] for each in requirements}
    return found - {"cangauge"}


def test_each_package_that_users_install_has_its_licence_stated(project: Path) -> None:
    text = (project / "docs" / "licences.md").read_text()
    about = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    packages = names(about["dependencies"])
    for extra, requirements in about["optional-dependencies"].items():
        if extra not in {"dev", "docs", "nightly"}:
            packages |= names(requirements)
    rows = " ".join(line for line in text.splitlines() if line.startswith("|"))
    stated = set(re.findall(r"[a-z][a-z0-9-]+", rows))
    assert packages - stated == set()


def test_each_dbc_states_its_licence(project: Path) -> None:
    text = (project / "docs" / "licences.md").read_text()
    files = sorted((project / "dbc").glob("*.dbc"))
    assert files
    for path in files:
        assert "Apache-2.0" in path.read_text()
        assert f"`{path.name}`" in text


def test_each_version_of_the_nightly_run_has_a_hash(project: Path) -> None:
    lines = (project / ".ci" / "nightly.txt").read_text().splitlines()[1:]
    assert len(lines) > 50
    for line in lines:
        assert re.fullmatch(r"[A-Za-z0-9_.-]+==\S+ --hash=sha256:[0-9a-f]{64}", line), line
