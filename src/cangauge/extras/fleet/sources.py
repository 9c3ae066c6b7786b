"""The logs of a fleet: a glob or a manifest → logs with their vehicle, in any storage of fsspec.

A log is recognised by its stamp: the storage's entity tag, or size and time of modification.
A remote log is copied to a temporary folder of the worker, since the readers of captures and logs
take files.
"""

from __future__ import annotations

import csv
import io
import json
import posixpath
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Final
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, Field, field_validator

from cangauge._config import validated
from cangauge._files import MAX_LOG_BYTES, as_utf8, text_sha256
from cangauge.bus.captures import Capture
from cangauge.bus.recording import (
    log_of,
    open_recording,
    refuse_single_row,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.identify.starts import with_start
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.log import Log
from cangauge.logs.read import LogFile
from cangauge.logs.sign import require_discharge_positive

_LONGEST_VEHICLE: Final = 255 - len("vehicle=")
"""Bytes of a vehicle's quoted name: file systems name a folder in 255."""
ABSENT: Final = "absent"
"""Stamp of a log that a manifest names and the storage does not have."""


@dataclass(frozen=True, slots=True)
class FleetLog:
    """One log of a fleet.

    Parameters
    ----------
    url : str
        Path or fsspec URL.
    vehicle : str
    stamp : str
        Changes with the content of the log.
    start : str
        Date and time of the first row (ISO 8601), or "".
    initial_soc_pct : float, optional
        SoC at the first row [%].
    healthy : bool
        Whether the log is known to be without a fault, and so a reference.
    """

    url: str
    vehicle: str
    stamp: str
    start: str = ""
    initial_soc_pct: float | None = None
    healthy: bool = False

    @property
    def start_s(self) -> float | None:
        """Time of the first row since 1970 [s]; None if unknown."""
        if not self.start:
            return None
        moment = datetime.fromisoformat(self.start)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def find_logs(given: Sequence[str]) -> list[FleetLog]:
    """Return the logs that paths, globs and manifests name, by vehicle, in order of their start.

    Parameters
    ----------
    given : sequence of str
        Paths or URLs; `*`, `?` and `**` stand for names and folders (unless a file is named so),
        and a table with a column `log` is a manifest. Paths in a manifest are relative to it.

    Raises
    ------
    InputError
        If nothing is found, a manifest is wrong, a log is named twice, or lies in no folder that
        names its vehicle.
    """
    found: dict[str, FleetLog] = {}
    for text in given:
        for log in _logs_of(text):
            if log.url in found:
                raise InputError("is named twice", source=log.url, cure="give each log once")
            folder = log.url.rpartition("/")[0].rpartition("/")[2]
            vehicle = log.vehicle or folder.removeprefix("vehicle=")
            if not vehicle:
                raise InputError(
                    "lies in no folder that names its vehicle",
                    source=log.url,
                    cure="give a manifest with the columns log and vehicle",
                )
            if len(quote(vehicle, safe="").encode()) > _LONGEST_VEHICLE:
                problem = f"a vehicle's name of {len(vehicle)} characters names no folder"
                raise InputError(problem, source=log.url, value=f"{vehicle[:40]}…")
            found[log.url] = replace(log, vehicle=vehicle)
    return sorted(found.values(), key=lambda log: (log.vehicle, log.start_s or 0.0, log.url))


def short_names(urls: Sequence[str]) -> list[str]:
    """Return paths or URLs without the folders that all of them share."""
    parts = [url.split("/") for url in urls]
    most = min(map(len, parts), default=1) - 1
    shared = 0
    while shared < most and len({path[shared] for path in parts}) == 1:
        shared += 1
    return ["/".join(path[shared:]) for path in parts]


def filesystem(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it.

    Raises
    ------
    InputError
        If fsspec, or the package of this storage, is not installed.
    """
    try:
        from fsspec.core import url_to_fs  # noqa: PLC0415 - an extra

        fs, path = url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"no access to this storage: {error}",
            source=url,
            cure="pip install 'cangauge[fleet]', and the package that fsspec needs for this"
            " storage, such as s3fs",
        ) from error
    return fs, path


def is_local(fs: Any) -> bool:
    """Return whether a file system is that of this machine."""
    return "local" in ((fs.protocol,) if isinstance(fs.protocol, str) else fs.protocol)


# --- Globs and manifests


def _logs_of(text: str) -> list[FleetLog]:
    """Return the logs that one text names, of which a manifest may state the vehicles."""
    fs, path = filesystem(text)
    is_glob = any(char in text for char in "*?[") and not fs.isfile(path)
    try:
        infos = list(fs.glob(path, detail=True).values()) if is_glob else [fs.info(path)]
    except FileNotFoundError as error:
        raise InputError("no such file", source=text, cure="check the path") from error
    except OSError as error:
        raise InputError(f"cannot be read: {error}", source=text) from error
    files = [info for info in infos if info["type"] == "file"]
    if not files and is_glob:
        raise InputError("no log is named like this", source=text, cure="check the pattern")
    if not files:
        raise InputError("is a folder", source=text, cure=f"give its logs: {text.rstrip('/')}/*")
    logs = [FleetLog(_url(fs, text, info["name"]), "", _stamp(info)) for info in files]
    if not is_glob and text.lower().endswith(".csv"):
        with fs.open(path, "rb") as file:
            headings, _ = _headings(as_utf8(file.read(4096)).decode())
        if "log" in headings:
            return _of_manifest(as_utf8(fs.cat_file(path)).decode(), logs[0].url)
    return logs


def _url(fs: Any, given: str, name: str) -> str:
    return str(fs.unstrip_protocol(name)) if "://" in given else posixpath.normpath(name)


def _stamp(info: Mapping[str, Any]) -> str:
    """Return what identifies the content of a file, from its entry in a listing."""
    tags = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "created")
    tag = next((str(info[key]) for key in tags if info.get(key)), "")
    return text_sha256(json.dumps([info.get("size"), tag]))[:16]


def _headings(text: str) -> tuple[list[str], str]:
    """Return the headings of a table as spreadsheets write it, and its delimiter."""
    first = next(iter(text.splitlines()), "")
    delimiter = next((mark for mark in "\t;," if mark in first), ",")
    return [cell.strip() for cell in next(csv.reader([first], delimiter=delimiter), [])], delimiter


class _Row(BaseModel):
    """A row of a manifest, without its empty cells."""

    model_config = ConfigDict(extra="forbid")

    log: str
    vehicle: str = ""
    start: str = ""
    initial_soc_pct: Annotated[float, Field(ge=0.0, le=100.0)] | None = None
    healthy: bool = False

    @field_validator("log")
    @classmethod
    def _is_no_chain(cls, log: str) -> str:
        if "::" in log:
            raise ValueError("a chain of URLs is not read: unpack the archive, and name its files")
        return log

    @field_validator("start")
    @classmethod
    def _is_a_date(cls, start: str) -> str:
        try:
            datetime.fromisoformat(start)
        except ValueError as error:
            raise ValueError("is no date such as 2024-05-01T08:30:00Z") from error
        return start

    @field_validator("initial_soc_pct", mode="before")
    @classmethod
    def _with_a_point(cls, soc_pct: str) -> str:
        return soc_pct.replace(",", ".")


def _of_manifest(text: str, url: str) -> list[FleetLog]:
    headings, delimiter = _headings(text)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    next(reader, None)
    folder, logs = url.rpartition("/")[0], []
    try:
        for cells in reader:
            row = {name: cell.strip() for name, cell in zip(headings, cells, strict=False)}
            if not any(row.values()):
                continue
            filled = {name: cell for name, cell in row.items() if cell}
            found = validated(_Row, filled, f"{url} line {reader.line_num}")
            is_whole = "://" in found.log or found.log.startswith("/") or not folder
            name = found.log if is_whole else f"{folder}/{found.log}"
            name = name if "://" in name else posixpath.normpath(name)
            logs.append(FleetLog(url=name, stamp="", **found.model_dump(exclude={"log"})))
    except csv.Error as error:
        raise InputError(f"not a table: {error}", source=url) from error
    for parent in {log.url.rpartition("/")[0] for log in logs}:  # fsspec remembers the listing
        fs, path = filesystem(parent or ".")
        with suppress(OSError):
            fs.ls(path, detail=True)
    return [replace(log, stamp=_stamp_of(log.url)) for log in logs]


def _stamp_of(url: str) -> str:
    fs, path = filesystem(url)
    try:
        return _stamp(fs.info(path))
    except OSError:
        return ABSENT


# --- Reading


@dataclass(frozen=True, eq=False)
class ReadOptions:
    """How the logs of a fleet are read, as by the options of every command.

    Parameters
    ----------
    vehicle : Vehicle, optional
        Decodes captures.
    columns : ColumnMap, optional
        Columns of a table, as a map file states them.
    described : str
        What identifies these options: the same text, the same rows.
    """

    vehicle: Vehicle | None = None
    columns: ColumnMap | None = None
    described: str = ""

    def open(self, path: Path) -> LogFile | Capture:
        """Open a recording (`open_recording`)."""
        return open_recording(path, mapped=self.columns)

    def read(self, log: FleetLog, path: Path) -> Log:
        """Read a log, or decode a capture, from its local copy; its start as the manifest states.

        Raises
        ------
        InputError
            As `cangauge.read_log`; if it has a single row, or its current is clearly inverted.
        """
        found = log_of(self.open(path), self.vehicle)
        refuse_single_row(found)
        require_discharge_positive(found)
        found = replace(found, source=log.url)
        return found if log.initial_soc_pct is None else with_start(found, log.initial_soc_pct)


@contextmanager
def local_file(url: str) -> Iterator[Path]:
    """Yield a local file with the content of a URL, of the same name.

    Raises
    ------
    InputError
        If there is no such file, or it is larger than a log may be.
    """
    fs, path = filesystem(url)
    if is_local(fs):
        yield Path(path)
        return
    try:
        if int(fs.info(path)["size"] or 0) > MAX_LOG_BYTES:
            raise InputError(f"larger than {MAX_LOG_BYTES >> 20} MiB", source=url)
        with tempfile.TemporaryDirectory(prefix="cangauge-") as folder:
            copy = Path(folder) / PurePosixPath(path).name
            fs.get_file(path, str(copy))
            yield copy
    except FileNotFoundError as error:
        raise InputError("no such file", source=url) from error
