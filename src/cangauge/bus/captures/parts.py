"""Recordings in parts: `drive-0003-000001.log`, `drive-0003-000002.log`, … are `drive-0003.log`.

`cangauge run` begins a new file now and then, and numbers its runs, so that nothing recorded
before is overwritten. The parts of one run are one capture.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final, NamedTuple

_RUN: Final = r"(?P<run>\d{4,9})"
_PART: Final = r"(?P<part>\d{6,9})"


class Part(NamedTuple):
    """One file of a recording."""

    run: int
    part: int
    path: Path


def part_path(path: Path, run: int, part: int) -> Path:
    """Return the name of a part of the recording `path`."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}-{part:06d}{suffix}")


def run_path(path: Path, run: int) -> Path:
    """Return the name that stands for all parts of a run."""
    stem, suffix = _split(path)
    return path.with_name(f"{stem}-{run:04d}{suffix}")


def all_parts(path: Path) -> list[Part]:
    """Return the parts of all runs of the recording `path`, in order; none if it has none."""
    stem, suffix = _split(path)
    pattern = re.compile(f"{re.escape(stem)}-{_RUN}-{_PART}{re.escape(suffix)}")
    try:
        names = list(path.parent.iterdir())
    except (OSError, ValueError):  # ValueError: a null byte in the path
        return []
    found = []
    for name in names:
        match = pattern.fullmatch(name.name)
        if match:
            found.append(Part(int(match["run"]), int(match["part"]), name))
    return sorted(found)


def parts_of_run(path: Path) -> list[Path]:
    """Return the files that a run's name, as `run_path` returns it, stands for.

    There are none where there is a file of that name, or where it is no run's name.
    """
    stem, suffix = _split(path)
    match = re.fullmatch(f"(?P<stem>.*)-{_RUN}", stem)
    try:
        is_run = match is not None and not path.exists()
    except OSError:  # a name that is too long
        return []
    if match is None or not is_run:
        return []
    base = path.with_name(match["stem"] + suffix)
    return [each.path for each in all_parts(base) if each.run == int(match["run"])]


def _split(path: Path) -> tuple[str, str]:
    """Return name and suffix, the latter with .gz's ("drive.log.gz": "drive", ".log.gz")."""
    name = path.name
    suffix = path.suffix
    if suffix.lower() == ".gz":
        suffix = Path(name.removesuffix(suffix)).suffix + suffix
    return name.removesuffix(suffix) if suffix else name, suffix
