"""Files of known formats that are not read here, and how each becomes a table or a capture.

Cyclers' own binary files have readers of their own; those libraries export CSV. SavvyCAN reads many
formats of captures (its `framefileio.cpp` lists them).
"""

from __future__ import annotations

import re
from typing import Final

from cangauge._files import Head

_READ_PACKED: Final = "; .gz, .bz2 and .zip are read as they are"
_BY_SAVVYCAN: Final = "open it in SavvyCAN, and save it as a GVRET log"
_FORMATS: Final = (
    (
        rb"ARROW1",
        "a Feather file",
        "store it as Parquet: pandas.read_feather(file).to_parquet('log.parquet')",
    ),
    (
        rb"\x89HDF\r\n\x1a\n",
        "an HDF5 file (also MATLAB 7.3)",
        "write its table as CSV: pandas.read_hdf(file).to_csv('log.csv'), or h5py for its arrays",
    ),
    (
        rb"MATLAB 5\.0 MAT-file",
        "a MATLAB file",
        "write its columns as CSV in MATLAB (writetable), or from scipy.io.loadmat(file)",
    ),
    (
        rb"SQLite format 3",
        "an SQLite database",
        "export the table: sqlite3 -csv -header FILE 'SELECT * FROM TABLE' > log.csv; frames logged"
        " by python-can: can_logconvert FILE drive.asc",
    ),
    (
        rb"BIO-LOGIC MODULAR FILE",
        "a BioLogic .mpr",
        "export it as text (.mpt) in EC-Lab, or by galvani: BioLogic.MPRfile(file).data",
    ),
    (
        rb"NEWARE",
        "a Neware .nda",
        "convert it with NewareNDA: NewareNDA.read(file).to_csv('log.csv')",
    ),
    (
        rb"EXPLAIN\r?\n",
        "a Gamry .dta",
        "name its columns: --columns 'time=T[s],voltage=Vf[V],current=Im[A]'",
    ),
    (
        rb"(?s).{4}Standard Jet DB",
        "an Access database, as Arbin's .res",
        "export it as CSV in MITS Pro, or by mdb-export of mdbtools",
    ),
    (rb"\xd0\xcf\x11\xe0", "an old Excel workbook (.xls)", "save it as .xlsx or CSV"),
    (rb"\xfd7zXZ", "packed by xz", f"unpack it (unxz FILE){_READ_PACKED}"),
    (rb"\x28\xb5\x2f\xfd", "packed by zstd", f"unpack it (unzstd FILE){_READ_PACKED}"),
    (rb"7z\xbc\xaf", "a 7z archive", f"unpack it{_READ_PACKED}"),
    (rb"Rar!", "a RAR archive", f"unpack it{_READ_PACKED}"),
    (
        rb"\xff\xfed\0a\0t\0e\0 \0",
        "a Vector ASC in UTF-16",
        "convert it: iconv -f UTF-16 -t UTF-8 FILE > drive.asc",
    ),
    (
        rb'\{"[^\n]*\}\r?(\n|$)',
        "JSON, a record a line",
        "make a table of it: pandas.read_json(file, lines=True).to_csv('log.csv', index=False)",
    ),
    (
        rb'\s*(\[\s*)?\{\s*"|\s*\[\s*\[',
        "JSON",
        "make a table of it: pandas.read_json(file).to_csv('log.csv', index=False)",
    ),
    (
        rb"\[[\d:.]+\]\[[A-Z]\]\[",
        "a log of ESPHome",
        "read the sensors from the history of Home Assistant or of InfluxDB, as CSV",
    ),
    (rb"(?i)\s*<(!doctype )?html", "a web page", "download the file itself, not the page about it"),
    (
        rb"\s*<\?xml",
        "XML",
        "make a table of it: pandas.read_xml(file).to_csv('log.csv', index=False)",
    ),
    (
        rb"\w[^\s,=]*(,[^\s,=]+=[^\s,]+)* [^\s=]+=\S+( \d+)?\r?\n",
        "InfluxDB's line protocol",
        "export it from InfluxDB as CSV: influx query --raw, or influx -format csv",
    ),
    # Captures
    (
        rb" *\([\d.]+\) +\S+ +[0-9A-F]+ +\[\d+\].*::",
        "what cantools decode prints",
        "give the capture itself, with --map",
    ),
    (rb"\*\*\*BUSMASTER", "a BUSMASTER log", _BY_SAVVYCAN),
    (rb"Chn +Identifier +Flg", "a Kvaser CanKing log", _BY_SAVVYCAN),
    (rb"# Logger type: CAN", "a CSS Electronics CLX000 log", _BY_SAVVYCAN),
    (rb"\d+\.\d+;[RT]X;0x", "a Microchip CAN analyser log", _BY_SAVVYCAN),
    (
        rb"(t[0-9A-F]{3}|T[0-9A-F]{8})[0-8]([0-9A-F]{2})*\r?\n",
        "slcan (Lawicel) text without time stamps",
        "record with stamps: send Z1 to the adapter first",
    ),
    (
        rb'"No\."',
        "Wireshark's list of packets, without their bytes",
        "save the packets themselves (File > Save As) as pcapng",
    ),
    (
        rb">?(AT ?MA|STMA?)\b",
        "what an ELM327 shows, without time stamps",
        "record with a CAN adapter whose program stamps the frames, such as SavvyCAN or candump -l",
    ),
    (  # last: so do frames in hexadecimal look
        rb"[^\n]*+\n(?: *+[-+\d.,eE]++(?<!,)(?=\s|$)){3,} *+(\n|$)",
        "a table: its columns are separated by blanks",
        "separate them by semicolons: sed -E 's/^ +//; s/ +/;/g' FILE > log.csv",
    ),
)
_FRAME_IDS: Final = {"id", "can id", "arb id", "identifier", "帧id"}
_FRAME_BYTES: Final = {"d0", "d1", "b1", "data", "data bytes", "dlc", "len", "数据(hex)"}


def foreign_format(head: Head) -> tuple[str, str] | None:
    """Return what a file is by its beginning, and the cure; None if it is not known."""
    text = "\n".join(head.lines).encode()  # also of UTF-16
    for pattern, name, cure in _FORMATS:
        if re.match(pattern, head.data) or re.match(pattern, text):
            return name, cure
    for line in head.lines[:10]:
        cells = {cell.strip(' "') for cell in re.split("[,;\t]", line.lower())}
        if cells & _FRAME_IDS and cells & _FRAME_BYTES:
            return "a table of CAN frames, not of a known form", (
                f"{_BY_SAVVYCAN}; or write its columns as cabana's CSV: the heading"
                " time,addr,bus,data, then seconds, id (0x…), number of the bus, bytes (0x…)"
            )
    return None
