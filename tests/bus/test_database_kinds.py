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


def arxml() -> str:
    """Return a system description of AUTOSAR 4 with one frame."""

    def method(name: str, slope: str, unit: str) -> str:
        return f"""<COMPU-METHOD><SHORT-NAME>{name}Method</SHORT-NAME><CATEGORY>LINEAR</CATEGORY>
<UNIT-REF DEST="UNIT">/U/{unit}</UNIT-REF><COMPU-INTERNAL-TO-PHYS><COMPU-SCALES><COMPU-SCALE>
<COMPU-RATIONAL-COEFFS><COMPU-NUMERATOR><V>0</V><V>{slope}</V></COMPU-NUMERATOR>
<COMPU-DENOMINATOR><V>1</V></COMPU-DENOMINATOR></COMPU-RATIONAL-COEFFS></COMPU-SCALE></COMPU-SCALES>
</COMPU-INTERNAL-TO-PHYS></COMPU-METHOD>"""

    def signal(name: str, base: str, unit: str) -> str:
        return f"""<SYSTEM-SIGNAL><SHORT-NAME>{name}System</SHORT-NAME><PHYSICAL-PROPS>
<SW-DATA-DEF-PROPS-VARIANTS><SW-DATA-DEF-PROPS-CONDITIONAL>
<COMPU-METHOD-REF DEST="COMPU-METHOD">/P/{name}Method</COMPU-METHOD-REF>
<UNIT-REF DEST="UNIT">/U/{unit}</UNIT-REF></SW-DATA-DEF-PROPS-CONDITIONAL>
</SW-DATA-DEF-PROPS-VARIANTS></PHYSICAL-PROPS></SYSTEM-SIGNAL>
<I-SIGNAL><SHORT-NAME>{name}</SHORT-NAME><LENGTH>16</LENGTH><NETWORK-REPRESENTATION-PROPS>
<SW-DATA-DEF-PROPS-VARIANTS><SW-DATA-DEF-PROPS-CONDITIONAL>
<BASE-TYPE-REF DEST="SW-BASE-TYPE">/P/{base}</BASE-TYPE-REF>
</SW-DATA-DEF-PROPS-CONDITIONAL></SW-DATA-DEF-PROPS-VARIANTS></NETWORK-REPRESENTATION-PROPS>
<SYSTEM-SIGNAL-REF DEST="SYSTEM-SIGNAL">/P/{name}System</SYSTEM-SIGNAL-REF></I-SIGNAL>"""

    def mapped(name: str, start: int) -> str:
        return f"""<I-SIGNAL-TO-I-PDU-MAPPING><SHORT-NAME>{name}Mapping</SHORT-NAME>
<I-SIGNAL-REF DEST="I-SIGNAL">/P/{name}</I-SIGNAL-REF>
<PACKING-BYTE-ORDER>MOST-SIGNIFICANT-BYTE-LAST</PACKING-BYTE-ORDER>
<START-POSITION>{start}</START-POSITION></I-SIGNAL-TO-I-PDU-MAPPING>"""

    def base(name: str, encoding: str) -> str:
        return f"""<SW-BASE-TYPE><SHORT-NAME>{name}</SHORT-NAME><BASE-TYPE-SIZE>16</BASE-TYPE-SIZE>
<BASE-TYPE-ENCODING>{encoding}</BASE-TYPE-ENCODING></SW-BASE-TYPE>"""

    return f"""<?xml version="1.0" encoding="UTF-8"?>
<AUTOSAR xmlns="http://autosar.org/schema/r4.0"><AR-PACKAGES>
<AR-PACKAGE><SHORT-NAME>U</SHORT-NAME><ELEMENTS>
<UNIT><SHORT-NAME>A</SHORT-NAME><DISPLAY-NAME>A</DISPLAY-NAME></UNIT>
<UNIT><SHORT-NAME>V</SHORT-NAME><DISPLAY-NAME>V</DISPLAY-NAME></UNIT></ELEMENTS></AR-PACKAGE>
<AR-PACKAGE><SHORT-NAME>P</SHORT-NAME><ELEMENTS>
{base("s16", "2C")}{base("u16", "NONE")}
{method("Current", "0.1", "A")}{method("Voltage", "0.1", "V")}
{signal("Current", "s16", "A")}{signal("Voltage", "u16", "V")}
<I-SIGNAL-I-PDU><SHORT-NAME>PackPdu</SHORT-NAME><LENGTH>8</LENGTH><I-SIGNAL-TO-PDU-MAPPINGS>
{mapped("Current", 0)}{mapped("Voltage", 16)}</I-SIGNAL-TO-PDU-MAPPINGS></I-SIGNAL-I-PDU>
<CAN-FRAME><SHORT-NAME>Pack</SHORT-NAME><FRAME-LENGTH>8</FRAME-LENGTH><PDU-TO-FRAME-MAPPINGS>
<PDU-TO-FRAME-MAPPING><SHORT-NAME>M</SHORT-NAME>
<PACKING-BYTE-ORDER>MOST-SIGNIFICANT-BYTE-LAST</PACKING-BYTE-ORDER>
<PDU-REF DEST="I-SIGNAL-I-PDU">/P/PackPdu</PDU-REF><START-POSITION>0</START-POSITION>
</PDU-TO-FRAME-MAPPING></PDU-TO-FRAME-MAPPINGS></CAN-FRAME>
<CAN-CLUSTER><SHORT-NAME>Hv</SHORT-NAME><CAN-CLUSTER-VARIANTS><CAN-CLUSTER-CONDITIONAL>
<PHYSICAL-CHANNELS><CAN-PHYSICAL-CHANNEL><SHORT-NAME>Channel</SHORT-NAME><FRAME-TRIGGERINGS>
<CAN-FRAME-TRIGGERING><SHORT-NAME>T</SHORT-NAME><FRAME-REF DEST="CAN-FRAME">/P/Pack</FRAME-REF>
<CAN-ADDRESSING-MODE>STANDARD</CAN-ADDRESSING-MODE><IDENTIFIER>291</IDENTIFIER>
</CAN-FRAME-TRIGGERING></FRAME-TRIGGERINGS></CAN-PHYSICAL-CHANNEL></PHYSICAL-CHANNELS>
</CAN-CLUSTER-CONDITIONAL></CAN-CLUSTER-VARIANTS></CAN-CLUSTER>
</ELEMENTS></AR-PACKAGE></AR-PACKAGES></AUTOSAR>
"""


@pytest.mark.parametrize(
    ("suffix", "text"),
    [("kcd", KCD), ("sym", SYM), ("arxml", arxml())],
    ids=["kcd", "sym", "arxml"],
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


def test_entities_are_refused(tmp_path: Path) -> None:
    database = tmp_path / "pack.kcd"
    database.write_text('<!DOCTYPE x [<!ENTITY a "aaaa">]><x>&a;</x>')
    (tmp_path / "map.toml").write_text(MAP)
    with pytest.raises(InputError, match="entities"):
        Vehicle.load(dbc=database, map=tmp_path / "map.toml")
