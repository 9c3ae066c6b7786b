"""KCD, SYM and ARXML files serve wherever a DBC does."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

MAP = '[current]\nsignal = "Current"\n[voltage]\nsignal = "Voltage"\n[temperature]\nfixed_c = 20\n'

KCD = """<?xml version="1.0" encoding="UTF-8"?>
<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0">
 <Document name="pack"/>
 <Bus name="hv">
  <Message id="0x123" name="Pack" length="8">
   <Signal name="Current" offset="0" length="16">
    <Value type="signed" slope="0.1" unit="A"/></Signal>
   <Signal name="Voltage" offset="16" length="16"><Value slope="0.1" unit="V"/></Signal>
  </Message>
 </Bus>
</NetworkDefinition>
"""
SYM = """FormatVersion=6.0 // a pack
Title="pack"

{SENDRECEIVE}

[Pack]
ID=123h
Len=8
Sig=Current 0
Sig=Voltage 16

{SIGNALS}
Sig=Current signed 16 /u:A /f:0.1
Sig=Voltage unsigned 16 /u:V /f:0.1
"""


@pytest.mark.parametrize(
    ("suffix", "text"),
    [("kcd", KCD), ("sym", SYM)],
    ids=["kcd", "sym"],
)
def test_signals_of_other_databases_decode(tmp_path: Path, suffix: str, text: str) -> None:
    database = tmp_path / f"pack.{suffix}"
    database.write_text(text)
    (tmp_path / "map.toml").write_text(MAP)
    decoder = SampleDecoder(Vehicle.load(dbc=database, map=tmp_path / "map.toml"))
    data = (-123).to_bytes(2, "little", signed=True) + (3654).to_bytes(2, "little") + bytes(4)
    message = can.Message(timestamp=1.0, arbitration_id=0x123, is_extended_id=False, data=data)
    sample = decoder.handle(message)
    assert sample is not None
    assert (sample.current_a, sample.voltage_v) == pytest.approx((-12.3, 365.4))


@pytest.mark.parametrize("suffix", ["kcd", "sym", "arxml"])
def test_broken_databases_name_their_kind(tmp_path: Path, suffix: str) -> None:
    database = tmp_path / f"pack.{suffix}"
    database.write_text("nonsense <")
    (tmp_path / "map.toml").write_text(MAP)
    with pytest.raises(InputError, match=suffix.upper()):
        Vehicle.load(dbc=database, map=tmp_path / "map.toml")
