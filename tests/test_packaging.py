"""The image names what pyproject.toml names."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


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


def test_image_pins_its_base_by_digest() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    bases = re.findall(r"^ARG BASE=(.*)$", text, re.MULTILINE)
    assert [bool(re.search(r"@sha256:[0-9a-f]{64}$", base)) for base in bases] == [True]
    assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) == {"${BASE}"}
