"""Files of known formats that are not read here, and how each becomes a table.

Cyclers' own binary files have readers of their own; those libraries export CSV.
"""

from __future__ import annotations

from typing import Final

_READ_PACKED: Final = "; .gz, .bz2 and .zip are read as they are"
_FORMATS: Final = (
    (0, b"ARROW1", "a Feather file",
     "store it as Parquet: pandas.read_feather(file).to_parquet('log.parquet')"),
    (0, b"\x89HDF\r\n\x1a\n", "an HDF5 file (also MATLAB 7.3)",
     "write its table as CSV: pandas.read_hdf(file).to_csv('log.csv'), or h5py for its arrays"),
    (0, b"MATLAB 5.0 MAT-file", "a MATLAB file",
     "write its columns as CSV in MATLAB (writetable), or from scipy.io.loadmat(file)"),
    (0, b"SQLite format 3", "an SQLite database",
     "export the table: sqlite3 -csv -header FILE 'SELECT * FROM TABLE' > log.csv; frames logged"
     " by python-can: can_logconvert FILE drive.asc"),
    (0, b"BIO-LOGIC MODULAR FILE", "a BioLogic .mpr",
     "export it as text (.mpt) in EC-Lab, or by galvani: BioLogic.MPRfile(file).data"),
    (0, b"NEWARE", "a Neware .nda",
     "convert it with NewareNDA: NewareNDA.read(file).to_csv('log.csv')"),
    (4, b"Standard Jet DB", "an Access database, as Arbin's .res",
     "export it as CSV in MITS Pro, or by mdb-export of mdbtools"),
    (0, b"\xd0\xcf\x11\xe0", "an old Excel workbook (.xls)", "save it as .xlsx or CSV"),
    (0, b"\xfd7zXZ", "packed by xz", f"unpack it (unxz FILE){_READ_PACKED}"),
    (0, b"\x28\xb5\x2f\xfd", "packed by zstd", f"unpack it (unzstd FILE){_READ_PACKED}"),
    (0, b"7z\xbc\xaf", "a 7z archive", f"unpack it{_READ_PACKED}"),
    (0, b"Rar!", "a RAR archive", f"unpack it{_READ_PACKED}"),
    (0, b'{"', "JSON, a record a line",
     "make a table of it: pandas.read_json(file, lines=True).to_csv('log.csv', index=False)"),
)  # fmt: skip


def foreign_format(data: bytes) -> tuple[str, str] | None:
    """Return what a file is by its first bytes, and the cure; None if it is not known."""
    for at, mark, name, cure in _FORMATS:
        if data[at : at + len(mark)] == mark:
            return name, cure
    return None
