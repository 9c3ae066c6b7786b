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
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, Final

from cangauge._files import MAX_LOG_BYTES, as_utf8, text_sha256
from cangauge.bus.captures import Capture
from cangauge.bus.recording import (
    log_of,
    open_with_columns,
    refuse_sign_of_capture,
    refuse_single_row,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.identify.starts import with_start
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.draft import Sign
from cangauge.logs.log import Log
from cangauge.logs.read import LogFile
from cangauge.logs.sign import require_discharge_positive
from cangauge.logs.text import split_cells
from cangauge.logs.units import TemperatureSource

VEHICLE_PATTERN: Final = r"(?:vehicle=)?([^/]+)/[^/]+$"
"""By default a vehicle is the folder that its logs lie in; also the hive layout."""

MAX_MANIFEST_BYTES: Final = 1024 * 1024 * 1024
"""A manifest is held in memory: ten million logs."""

MANIFEST_COLUMNS: Final = ("log", "vehicle", "start", "initial_soc_pct", "healthy")
TRUE: Final = frozenset({"1", "true", "yes"})
FALSE: Final = frozenset({"", "0", "false", "no"})
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
    fold : int
        Fold that holds the log out in cross-validation.
    """

    url: str
    vehicle: str
    stamp: str
    start: str = ""
    initial_soc_pct: float | None = None
    healthy: bool = False
    fold: int = 0

    @property
    def stated(self) -> str:
        """What a manifest or pattern states of the log: vehicle, start, and the SoC there."""
        return f"{self.vehicle} {self.start} {self.initial_soc_pct}"

    @property
    def start_s(self) -> float | None:
        """Time of the first row since 1970 [s]; None if unknown."""
        if not self.start:
            return None
        moment = datetime.fromisoformat(self.start)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def find_logs(given: Sequence[str], *, pattern: str = VEHICLE_PATTERN) -> list[FleetLog]:
    """Return the logs that paths, globs and manifests name, by vehicle, in order of their start.

    Parameters
    ----------
    given : sequence of str
        Paths or URLs; `*`, `?` and `**` stand for names and folders (unless a file is named so),
        and a table with a column `log` is a manifest. Paths in a manifest are relative to it.
    pattern : str
        Regular expression of which the first group finds the vehicle in a URL.

    Raises
    ------
    InputError
        If nothing is found, a manifest is wrong, a log is named twice, or the pattern finds no
        vehicle.
    """
    expression = _compiled(pattern)
    found: list[FleetLog] = []
    for text in given:
        found += _of_glob(text, expression) if _is_glob(text) else _of_file(text, expression)
    by_url: dict[str, FleetLog] = {}
    for log in found:
        if log.url in by_url:
            raise InputError("is named twice", source=log.url, cure="give each log once")
        by_url[log.url] = log
    return sorted(found, key=lambda log: (log.vehicle, log.start_s or 0.0, log.url))


def short_names(urls: Sequence[str]) -> list[str]:
    """Return paths or URLs without the folders that all of them share."""
    parts = [url.split("/") for url in urls]
    most = min(map(len, parts), default=1) - 1
    shared = 0
    while shared < most and len({each[shared] for each in parts}) == 1:
        shared += 1
    return ["/".join(each[shared:]) for each in parts]


def filesystem(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it.

    Raises
    ------
    InputError
        If fsspec, or the package of this storage, is not installed.
    """
    try:
        from fsspec.core import url_to_fs  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "fsspec is not installed", source=url, cure="pip install 'cangauge[fleet]'"
        ) from error
    try:
        fs, path = url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"no access to this storage: {error}",
            source=url,
            cure="install the package that fsspec needs for it, such as s3fs",
        ) from error
    return fs, path


def _compiled(pattern: str) -> re.Pattern[str]:
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise InputError(
            f"not a regular expression: {error}", field="--vehicle-pattern", value=pattern
        ) from error
    if expression.groups < 1:
        raise InputError(
            "has no group", field="--vehicle-pattern", value=pattern,
            cure="mark the vehicle by (…), as in 'logs/([^/]+)/'",
        )  # fmt: skip
    return expression


def _is_glob(text: str) -> bool:
    if not any(char in text for char in "*?["):
        return False
    fs, path = filesystem(text)
    return not fs.isfile(path)  # a file may be named like a glob


def _vehicle_of(url: str, expression: re.Pattern[str]) -> str:
    match = expression.search(url)
    if match is None or not match[1]:
        raise InputError(
            "the pattern finds no vehicle in this name",
            source=url,
            field="--vehicle-pattern",
            value=expression.pattern,
            cure="give another pattern, or a manifest with the columns log and vehicle",
        )
    return match[1]


def _of_glob(text: str, expression: re.Pattern[str]) -> list[FleetLog]:
    fs, path = filesystem(text)
    try:
        infos = fs.glob(path, detail=True)
    except OSError as error:
        raise InputError(f"cannot be listed: {error}", source=text) from error
    files = [info for info in infos.values() if info["type"] == "file"]
    if not files:
        raise InputError("no log is named like this", source=text, cure="check the pattern")
    urls = [(_url(fs, text, info["name"]), _stamp(info)) for info in files]
    return [FleetLog(url, _vehicle_of(url, expression), stamp) for url, stamp in urls]


def _of_file(text: str, expression: re.Pattern[str]) -> list[FleetLog]:
    fs, path = filesystem(text)
    try:
        info = fs.info(path)
    except FileNotFoundError as error:
        raise InputError("no such file", source=text) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error}", source=text) from error
    if info["type"] != "file":
        raise InputError("is a folder", source=text, cure=f"give its logs: {text.rstrip('/')}/*")
    url = _url(fs, text, info["name"])
    if text.lower().endswith(".csv") and _is_manifest(fs, path):
        return _of_manifest(fs, path, url, expression)
    return [FleetLog(url, _vehicle_of(url, expression), _stamp(info))]


def _url(fs: Any, given: str, name: str) -> str:
    return str(fs.unstrip_protocol(name)) if "://" in given else posixpath.normpath(name)


def _is_manifest(fs: Any, path: str) -> bool:
    with fs.open(path, "rb") as file:
        return "log" in _headings(as_utf8(file.read(4096)).decode())[0]


def _headings(text: str) -> tuple[list[str], str]:
    """Return the headings of a table as spreadsheets write it, and its delimiter."""
    first = _lines(text).readline().rstrip("\r\n")
    delimiter = next((mark for mark in "\t;," if mark in first), ",")
    return split_cells(first, delimiter), delimiter


def _lines(text: str) -> io.StringIO:
    """Return a text whose lines may end by LF, CR LF or CR."""
    return io.StringIO(text, newline="")


def _manifest_rows(text: str, url: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the rows of a manifest that have a cell, each with its place, by column."""
    headings, delimiter = _headings(text)
    unknown = sorted(set(headings) - set(MANIFEST_COLUMNS))
    if unknown:
        raise InputError(
            f"not a column of a manifest: {', '.join(unknown)}", source=url, field=unknown[0],
            cure=f"use {', '.join(MANIFEST_COLUMNS)}",
        )  # fmt: skip
    table = _lines(text)
    table.readline()
    reader = csv.reader(table, delimiter=delimiter)
    try:
        for cells in reader:
            row = {name: cell.strip() for name, cell in zip(headings, cells, strict=False)}
            if any(row.values()):
                yield f"{url} line {reader.line_num + 1}", row
    except csv.Error as error:
        raise InputError(f"not a table: {error}", source=url) from error


def _of_manifest(fs: Any, path: str, url: str, expression: re.Pattern[str]) -> list[FleetLog]:
    if fs.size(path) > MAX_MANIFEST_BYTES:
        raise InputError(f"larger than {MAX_MANIFEST_BYTES >> 20} MiB", source=url)
    text = as_utf8(fs.cat_file(path)).decode()
    folder = url.rpartition("/")[0]
    rows = []
    for at, row in _manifest_rows(text, url):
        name = row.get("log", "")
        if not name:
            raise InputError("names no log", source=at, field="log")
        is_whole = "://" in name or name.startswith("/")
        whole = name if is_whole or not folder else f"{folder}/{name}"
        rows.append(_manifest_log(row, whole if "://" in whole else posixpath.normpath(whole), at))
    stamps = _stamps([log.url for log in rows])
    return [
        replace(
            log,
            vehicle=log.vehicle or _vehicle_of(log.url, expression),
            stamp=stamps.get(log.url, ABSENT),
        )
        for log in rows
    ]


def _manifest_log(row: Mapping[str, str], url: str, at: str) -> FleetLog:
    initial, start = row.get("initial_soc_pct", ""), row.get("start", "")
    healthy = row.get("healthy", "").lower()
    if healthy not in TRUE | FALSE:
        raise InputError("neither yes nor no", source=at, field="healthy", value=healthy)
    vehicle = row.get("vehicle", "")
    log = FleetLog(url, vehicle, "", start, _soc_pct(initial, at), healthy in TRUE)
    try:
        _ = log.start_s
    except ValueError as error:
        raise InputError(
            "not a date", source=at, field="start", value=start,
            cure="give it as 2024-05-01T08:30:00Z",
        ) from error  # fmt: skip
    return log


def _soc_pct(cell: str, at: str) -> float | None:
    """Return the SoC of a cell, with a decimal point or comma [%]; None if it is empty."""
    if not cell:
        return None
    try:
        soc_pct = float(cell.replace(",", "."))
    except ValueError as error:
        raise InputError(
            "not a number of %", source=at, field="initial_soc_pct", value=cell
        ) from error
    if not 0.0 <= soc_pct <= 100.0:
        raise InputError(
            "must lie within 0 … 100 %", source=at, field="initial_soc_pct", value=soc_pct
        )
    return soc_pct


def _stamps(urls: Sequence[str]) -> dict[str, str]:
    """Return the stamps of the logs that exist; each folder is listed once."""
    found: dict[str, str] = {}
    by_folder: dict[str, list[str]] = {}
    for url in urls:
        by_folder.setdefault(url.rpartition("/")[0], []).append(url)
    for folder, members in by_folder.items():
        fs, _ = filesystem(members[0])
        paths = {fs._strip_protocol(url): url for url in members}  # noqa: SLF001 - fsspec's way
        try:
            infos = fs.ls(fs._strip_protocol(folder or "."), detail=True)  # noqa: SLF001
        except OSError:
            continue
        for info in infos:
            if info["name"] in paths and info["type"] == "file":
                found[paths[info["name"]]] = _stamp(info)
    return found


def _stamp(info: Mapping[str, Any]) -> str:
    """Return what identifies the content of a file, from its entry in a listing."""
    tag = info.get("ETag") or info.get("etag") or info.get("md5Hash")
    when = next(
        (info[key] for key in ("mtime", "LastModified", "last_modified", "created") if key in info),
        "",
    )
    return text_sha256(json.dumps([info.get("size"), str(tag or when)]))[:16]


@dataclass(frozen=True, eq=False)
class ReadOptions:
    """How the logs of a fleet are read, as by the options of every command.

    Parameters
    ----------
    vehicle : Vehicle, optional
        Decodes captures.
    columns, mapped : ColumnMap, optional
        Columns of a table: the user's, and those of a map file.
    sign : {"charge", "discharge"}, optional
    temperature_c : float, optional
        Constant temperature [°C].
    temperature_source : str, optional
    described : str
        What identifies these options: the same text, the same rows.
    """

    vehicle: Vehicle | None = None
    columns: ColumnMap | None = None
    mapped: ColumnMap | None = None
    sign: Sign | None = None
    temperature_c: float | None = None
    temperature_source: TemperatureSource | None = None
    described: str = ""

    def open(self, path: Path) -> LogFile | Capture:
        """Open a recording (`open_with_columns`).

        Raises
        ------
        InputError
            If the file cannot be read, or the sign is stated for a capture.
        """
        found = open_with_columns(path, columns=self.columns, mapped=self.mapped, sign=self.sign)
        refuse_sign_of_capture(found, self.sign)
        return found

    def read(self, path: Path, url: str) -> Log:
        """Read a log, or decode a capture, from a local copy of `url`.

        Raises
        ------
        InputError
            As `cangauge.read_log`; if it has a single row, or its current is clearly inverted.
        """
        log = log_of(
            self.open(path),
            self.vehicle,
            temperature_c=self.temperature_c,
            temperature_source=self.temperature_source,
        )
        refuse_single_row(log)
        if self.sign is None:
            require_discharge_positive(log)
        return replace(log, source=url)

    def read_log(self, log: FleetLog, path: Path) -> Log:
        """Read a log of a fleet, with the SoC at its first row that a manifest states.

        Raises
        ------
        InputError
            As `read`.
        """
        found = self.read(path, log.url)
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
    if "local" in ((fs.protocol,) if isinstance(fs.protocol, str) else fs.protocol):
        yield Path(path)
        return
    try:
        size = int(fs.info(path)["size"] or 0)
        if size > MAX_LOG_BYTES:
            raise InputError(f"larger than {MAX_LOG_BYTES >> 20} MiB", source=url)
        with tempfile.TemporaryDirectory(prefix="cangauge-") as folder:
            copy = Path(folder) / PurePosixPath(path).name
            fs.get_file(path, str(copy))
            yield copy
    except FileNotFoundError as error:
        raise InputError("no such file", source=url) from error
