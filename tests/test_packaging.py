"""The recipes of other package managers and images name what pyproject.toml names."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
BOUND = re.compile(r"([A-Za-z0-9_.-]+)(?:\[[^]]*\])?\s*>=([0-9.]+)")


def test_conda_recipe_has_the_dependencies_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    # A bound for one Python is for its wheels; conda has its own builds.
    found = [BOUND.match(each) for each in project["dependencies"] if ";" not in each]
    wanted = {match[1]: match[2] for match in found if match}
    assert len(wanted) == len(found)
    recipe = (ROOT / "contrib" / "conda" / "meta.yaml").read_text(encoding="utf-8")
    run = recipe.partition("\n  run:\n")[2].partition("\n\n")[0]
    listed = {match[1]: match[2] for match in BOUND.finditer(run)}
    assert listed.pop("python") == project["requires-python"].removeprefix(">=")
    assert listed.pop("msgpack-python")  # what python-can's extra "multicast" installs
    assert listed == wanted
    assert f'version: "{project["version"]}"' in recipe


def test_image_copies_what_the_build_needs() -> None:
    described = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = described["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {"pyproject.toml", *wheel["force-include"], described["project"]["readme"]}
    needed |= {path.partition("/")[0] for path in wheel["packages"]}
    needed |= set(described["project"]["license-files"])
    needed |= {"hatch_build.py"} if "custom" in wheel["hooks"] else set()
    build = (ROOT / "Dockerfile").read_text(encoding="utf-8").partition("\n\nFROM ")[0]
    lines = re.findall(r"^COPY (.*)$", build, re.MULTILINE)
    copied = {word for line in lines for word in line.split()}
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert needed <= copied
    assert needed <= {line.removeprefix("!") for line in ignored if line.startswith("!")}
