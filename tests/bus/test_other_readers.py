"""Our files in other programs: DBC in SavvyCAN and canmatrix, MCAP in Foxglove, PlotJuggler."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import cantools.database
import pytest
from cantools.database.can import Database

from cangauge._resources import shared_file
from live import waits
from running import RunningService

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


def test_an_mcap_recording_is_complete_for_its_own_reader(tmp_path: Path) -> None:
    """Foxglove and PlotJuggler read channels of "json" with a schema of "jsonschema"."""
    reader_of = pytest.importorskip("mcap.reader", reason="needs the extra cangauge[mcap]")
    jsonschema = pytest.importorskip("jsonschema")
    with RunningService(tmp_path, 'record = "drive.mcap"\n') as running:
        assert waits(lambda: running.service.pipeline.samples > 30)
        time.sleep(0.2)
    [path] = tmp_path.glob("drive*.mcap")
    with path.open("rb") as file:
        reader = reader_of.make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.chunk_indexes  # what a player seeks by
        validators = {}
        for schema in summary.schemas.values():
            assert schema.encoding == "jsonschema"
            content = json.loads(schema.data)
            assert content["type"] == "object"  # Foxglove takes no other root
            jsonschema.Draft202012Validator.check_schema(content)
            validators[schema.id] = jsonschema.Draft202012Validator(content)
        assert {each.message_encoding for each in summary.channels.values()} == {"json"}
        topics = {each.topic for each in summary.channels.values()}
        assert {"/sample", "/soc_estimate"} < topics
        count, latest = 0, 0
        for schema, _, message in reader.iter_messages(log_time_order=True):
            validators[schema.id].validate(json.loads(message.data))
            assert message.log_time >= latest
            count, latest = count + 1, message.log_time
        assert count == summary.statistics.message_count
        assert count > 100
