"""Our files in other programs: DBC in SavvyCAN and canmatrix, MCAP in Foxglove, PlotJuggler."""

from __future__ import annotations

import re

import cantools.database
import pytest
from cantools.database.can import Database

from cangauge._resources import shared_file

NAMES = sorted(path.name for path in shared_file("dbc", "soc_estimate.dbc").parent.glob("*.dbc"))

# SavvyCAN reads line by line: what does not fit in one line in this form is not loaded.
NUMBER = r"[0-9.+\-eE]+"
SAVVYCAN = {
    "BO_ ": re.compile(r"BO_ \d+ \w+ ?: \d+ \w+"),
    "SG_ ": re.compile(
        rf"SG_ \w+( M| m\d+)? : \d+\|\d+@[01][+-] \({NUMBER},{NUMBER}\)"
        rf' \[{NUMBER}\|{NUMBER}\] ".*" \w.*'
    ),
    "CM_ ": re.compile(r'CM_ ((BO_|BU_) \w+ |SG_ \d+ \w+ )?"[^"]*";'),
    "VAL_ ": re.compile(r'VAL_ \d+ \w+ (-?\d+ "[^"]*" )+;'),
    "BA_DEF_ ": re.compile(r'BA_DEF_ ((BO_|SG_|BU_) )?"\w+" (INT|FLOAT|STRING|ENUM) ?.*;'),
}


@pytest.mark.parametrize("name", NAMES)
def test_savvycan_reads_each_line(name: str) -> None:
    read = 0
    for line in shared_file("dbc", name).read_text(encoding="utf-8").splitlines():
        for begin, form in SAVVYCAN.items():
            if line.strip().startswith(begin):
                assert form.fullmatch(" ".join(line.split())), line
                read += 1
    assert read > 10


@pytest.mark.parametrize("name", NAMES)
def test_canmatrix_and_cantools_read_the_same_signals(name: str) -> None:
    formats = pytest.importorskip("canmatrix.formats", reason="needs the package canmatrix")
    path = str(shared_file("dbc", name))
    theirs = formats.loadp_flat(path)
    ours = cantools.database.load_file(path, strict=True)
    assert isinstance(ours, Database)
    found = {
        (frame.arbitration_id.id, frame.size, signal.name): (
            signal.size,
            float(signal.factor),
            float(signal.offset),
            signal.is_signed,
            signal.is_little_endian,
            signal.unit or "",
            {int(value): text for value, text in signal.values.items()},
        )
        for frame in theirs.frames
        for signal in frame.signals
    }
    expected = {
        (message.frame_id, message.length, signal.name): (
            signal.length,
            float(signal.scale),
            float(signal.offset),
            signal.is_signed,
            signal.byte_order == "little_endian",
            signal.unit or "",
            {int(value): str(text) for value, text in (signal.choices or {}).items()},
        )
        for message in ours.messages
        for signal in message.signals
    }
    assert found == expected
