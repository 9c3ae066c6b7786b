"""File access: limits of size and time, safe opening, atomic writing, one writer to a file.

Limits are far above real files and far below the memory of a small machine. A file beyond a limit
raises `InputError` before it costs time or memory.
"""

from __future__ import annotations

import bz2
import errno
import gzip
import hashlib
import io
import os
import secrets
import signal
import stat
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, BinaryIO, Final, cast

from cangauge.errors import CangaugeError, InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment] # checked before use

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

MIB: Final = 1 << 20

# Packed files (gzip, zip)
UNPACK_FREE_BYTES: Final = 16 * MIB
"""Content of at most this size is unpacked at any ratio."""
UNPACK_RATIO: Final = 250
"""Largest ratio of unpacked to packed size beyond it [-] (real recordings: up to 43)."""

# Logs
MAX_LOG_BYTES: Final = 1024 * MIB
"""A log, packed or unpacked: it is held in memory."""
MAX_LOG_ROWS: Final = 20_000_000
"""Rows of a log, samples of a capture: 23 days at 10 Hz, 0.8 GB as float64."""
MAX_LOG_COLUMNS: Final = 10_000
MAX_LOG_SPAN_S: Final = 366 * 86400.0
"""First to last row [s]: setting the clock within a log can add decades."""
MAX_HEADING: Final = 200
"""Longest column heading that is parsed [characters]."""
MAX_ODD_ROWS: Final = 100
"""Rows with a wrong number of cells after which reading stops."""
MAX_PARQUET_NAMES: Final = 16 * MIB
"""Longest text, and longest list, in a Parquet footer [bytes, items]."""

# Captures
MAX_CAPTURE_BYTES: Final = 64 * 1024 * MIB
"""A capture, unpacked: it is read as a stream."""
MAX_LINE: Final = 16 * 1024
"""Longest line of a text capture [characters]."""
MAX_IDLE_LINES: Final = 1_000_000
"""Consecutive lines without a frame."""
MAX_BLF_OBJECT: Final = 16 * MIB
"""One object of a BLF file, packed or unpacked (writers fill 128 KiB)."""
MAX_MCAP_RECORD: Final = 64 * MIB
"""One record of an MCAP file, packed or unpacked (writers fill chunks of 1–4 MiB)."""
MAX_MF4_MEMORY: Final = 4096 * MIB
"""Memory of the process that reads an MF4 file."""
MF4_SILENCE_S: Final = 60.0
"""Longest wait for the next frames of that process [s], plus …"""
MF4_SILENCE_S_PER_MIB: Final = 0.5
"""… this for each MiB of the file [s]."""
MAX_BUSES: Final = 64
"""Buses in one capture: each has its own decoder."""
MAX_STAMP_S: Final = 1e11
"""Largest time stamp of a frame or row [s]: the year 5138, counted from 1970."""

# DBC, TOML and model files
MAX_DBC_BYTES: Final = 4 * MIB
"""Parsing takes 1–6 s a megabyte; the largest files in use are smaller."""
MAX_TOML_BYTES: Final = 64 * 1024
MAX_TOML_KEY: Final = 32
"""Parts of a dotted key: parsing takes time and memory with their square."""
MAX_MODEL_BYTES: Final = 4 * MIB
"""A model with 64 delays has 0.2 MB."""
MAX_MODEL_COLUMNS: Final = 256
"""Columns of the information matrix in a model file."""
MAX_MODEL_ITEMS: Final = 4096
"""Source logs, options and coefficients in a model file, each."""
MAX_MODEL_EFFECTS: Final = 32
"""Effects in a model file: each costs time at every sample, and the library has 22 kinds."""
MAX_SPEED_TRACE_BYTES: Final = 64 * MIB
READ_WITHIN_S: Final = 120.0
"""Time for reading a configuration with its model, map and DBC [s]: the largest DBC takes up to
24 s (see `MAX_DBC_BYTES`), on a machine five times slower 120 s."""
MAX_READING_MEMORY: Final = 2048 * MIB
"""Memory of the process that does so; the largest DBC takes 0.3 GB."""


# --- Reading

_UNPACKERS: Final = {b"\x1f\x8b": gzip.GzipFile, b"BZh": bz2.BZ2File}
# Opening these could block, never end, or trigger a device.
_NOT_FILES: Final = (
    (stat.S_ISFIFO, "this is a pipe (FIFO), not a file"),
    (stat.S_ISCHR, "this is a device, not a file"),
    (stat.S_ISBLK, "this is a device, not a file"),
    (stat.S_ISSOCK, "this is a socket, not a file"),
)


def open_regular(path: str | PathLike[str]) -> BinaryIO:
    """Open a regular file for reading.

    Raises
    ------
    InputError
        If it is absent, a folder, a device, a pipe or a socket, or cannot be read.
    """
    try:
        _refuse_special(Path(path).stat().st_mode, path)
        # If it is swapped for a pipe right now, O_NONBLOCK keeps `open` from waiting for a writer.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        file = cast("BinaryIO", os.fdopen(os.open(path, flags), "rb"))
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise _unreadable(error, path) from error
    try:
        _refuse_special(os.fstat(file.fileno()).st_mode, path)
    except InputError:
        file.close()
        raise
    return file


def open_unpacked(path: str | PathLike[str], limit: int) -> io.BufferedReader:
    """Open a regular file for reading; gzip and bzip2 are recognised by content and unpacked.

    A damaged packed file raises `EOFError`, `OSError` or `zlib.error` while it is read.

    Parameters
    ----------
    path : path-like
    limit : int
        Largest unpacked content [bytes].

    Raises
    ------
    InputError
        As `open_regular`; while reading, if it unpacks to more than `limit` or beyond
        `UNPACK_RATIO`.
    """
    file = open_regular(path)
    try:
        beginning = file.read(3)
        file.seek(0)
    except OSError as error:
        file.close()
        raise _unreadable(error, path) from error
    unpack = next((each for mark, each in _UNPACKERS.items() if beginning.startswith(mark)), None)
    if unpack is None:
        return cast("io.BufferedReader", file)
    unpacked = gzip.GzipFile(fileobj=file) if unpack is gzip.GzipFile else bz2.BZ2File(file)
    return bounded(unpacked, path, limit, os.fstat(file.fileno()).st_size, also_close=file)


def bounded(
    unpacked: io.BufferedIOBase,
    path: str | PathLike[str],
    limit: int,
    packed_bytes: int,
    *,
    also_close: BinaryIO | None = None,
) -> io.BufferedReader:
    """Return a reader of unpacked content that raises `InputError` beyond its bounds.

    Parameters
    ----------
    unpacked : buffered reader
        The content; closed with the returned reader.
    path : path-like
        For the message.
    limit : int
        Largest content [bytes].
    packed_bytes : int
        Size of the packed file [bytes], for the ratio.
    also_close : binary file, optional
        Another file to close with the reader.
    """
    limit = min(limit, max(UNPACK_FREE_BYTES, UNPACK_RATIO * packed_bytes))
    return io.BufferedReader(_Bounded(unpacked, path, limit, also_close))


class _Bounded(io.RawIOBase):
    """A stream that raises InputError after `limit` bytes."""

    def __init__(
        self,
        source: io.BufferedIOBase,
        path: str | PathLike[str],
        limit: int,
        also_close: BinaryIO | None,
    ) -> None:
        self._source = source
        self._path = path
        self._limit = limit
        self._also_close = also_close
        self._delivered = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer)
        # `read1`: the content before a break in the file is delivered before the error.
        part = self._source.read1(view.nbytes)
        self._delivered += len(part)
        if self._delivered > self._limit:
            raise InputError(
                f"unpacks to more than {_megabytes(self._limit)}, too much for a recording of its"
                " size",
                source=self._path,
                cure="unpack it and check its content",
            )
        view[: len(part)] = part
        return len(part)

    def close(self) -> None:
        if not self.closed:
            self._source.close()
            if self._also_close is not None:
                self._also_close.close()
        super().close()


def read_beginning(file: io.BufferedReader, size: int) -> bytes:
    """Return at most `size` bytes from an open file; fewer where it is damaged or ends."""
    beginning = bytearray()
    with suppress(EOFError, OSError, zlib.error):
        while len(beginning) < size and (part := file.read1(size - len(beginning))):
            beginning += part
    return bytes(beginning)


def read_bounded(path: str | PathLike[str], limit: int, what: str) -> bytes:
    """Return the content of a regular file.

    Parameters
    ----------
    path : path-like
    limit : int
        Largest file [bytes].
    what : str
        The expected kind of file, for the message ("a model file").

    Raises
    ------
    InputError
        As `open_regular`, or if the file is larger.
    """
    try:
        with open_regular(path) as file:
            return read_all(file, path, limit, what)
    except OSError as error:
        raise _unreadable(error, path) from error


def read_all(file: BinaryIO, path: str | PathLike[str], limit: int, what: str) -> bytes:
    """Return the rest of an open file; raise InputError if it has more than `limit` bytes."""
    data = bytearray()
    # In pieces: a single `read` would allocate the file's whole size first.
    while len(data) <= limit and (piece := file.read(MIB)):
        data += piece
    if len(data) > limit:
        raise InputError(
            f"larger than the {_megabytes(limit)} that {what} may have",
            source=path,
            cure="check that this is the right file, or split it",
        )
    return bytes(data)


class _OutOfTime(BaseException):
    """Not an Exception: parsers catch those."""


_limited: bool = False


@contextmanager
def time_limit(path: str | PathLike[str], seconds: float = READ_WITHIN_S) -> Iterator[None]:
    """Raise InputError if the block takes longer [s]; the outermost limit counts.

    For parsers in Python: a call into C is interrupted at its end. Without effect outside the main
    thread and on Windows, which have no signal to interrupt with.

    Parameters
    ----------
    path : path-like
        The file that is read, for the message.
    seconds : float
    """
    global _limited  # noqa: PLW0603 - there is one timer in a process
    is_main = threading.current_thread() is threading.main_thread()
    if _limited or not is_main or not hasattr(signal, "setitimer"):
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise _OutOfTime

    before = signal.signal(signal.SIGALRM, interrupt)
    began_s = time.monotonic()
    # Repeated: a finalizer, in which Python ignores exceptions, may meet the first one.
    left_s, _ = signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    _limited = True
    try:
        yield
    except _OutOfTime:
        raise InputError(
            f"takes more than {seconds:g} s to read",
            source=path,
            cure="remove the messages and values that you do not need, or read it on a faster"
            " machine",
        ) from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        _limited = False
        signal.signal(signal.SIGALRM, before)
        if left_s:
            elapsed_s = time.monotonic() - began_s
            signal.setitimer(signal.ITIMER_REAL, max(left_s - elapsed_s, 1e-3))


def _megabytes(size: int) -> str:
    return f"{size // MIB} MB" if size >= MIB else f"{size // 1024} kB"


def _refuse_special(mode: int, path: str | PathLike[str]) -> None:
    if stat.S_ISDIR(mode):
        raise InputError("this is a folder, not a file", source=path, cure="name a file in it")
    for is_kind, problem in _NOT_FILES:
        if is_kind(mode):
            raise InputError(problem, source=path, cure="save its content as a file and name that")


def _unreadable(error: OSError | ValueError, path: str | PathLike[str]) -> InputError:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return InputError("no such file", source=path, cure="check the path")
    reason = getattr(error, "strerror", None) or str(error)
    cure = "change its rights" if isinstance(error, PermissionError) else "check the path"
    return InputError(f"cannot be read: {reason}", source=path, cure=cure)


# --- Writing

FULL: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""Errors of a full or failing disk, which can be temporary."""
_WRITE_ERRORS: Final[dict[int, tuple[str, str]]] = {
    errno.ENOENT: ("the folder of this file does not exist", "create it or name another one"),
    errno.ENOTDIR: ("a part of this path is a file, not a folder", "name another path"),
    errno.EACCES: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EPERM: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EROFS: ("the file system is read-only", "name another folder"),
    errno.ENAMETOOLONG: ("the file name is too long", "use a shorter one"),
}


PRIVATE: Final = 0o600
"""Rights of a state: for its owner only."""
FOR_GROUP: Final = 0o640
"""Rights of a recording: the group may read where and how the car was driven, others not."""


@contextmanager
def atomic_path(path: str | PathLike[str], rights: int | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path` and rename it to `path` when the block succeeds.

    The temporary file exists (empty), is on the same file system and keeps the suffix. If the
    block raises, it is removed and `path` is unchanged. The content is synced to disk before
    the rename: a power cut leaves the old file or the new one. A device or pipe (`/dev/stdout`)
    cannot be replaced and is yielded itself.

    Parameters
    ----------
    path : path-like
        The file to write; a symbolic link is followed (see `refuse_foreign`).
    rights : int, optional
        Its permissions. By default those of the file that is replaced, or the umask's.

    Yields
    ------
    Path
        Where to write.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or `path` is a folder or foreign.
    CangaugeError
        If the disk is full or fails while writing.
    """
    refuse_foreign(path)
    target = Path(path)
    if _is_device(target):
        yield target
        return
    target = Path(os.path.realpath(target))
    part = _create_beside(target, shown=path, rights=0o666 if rights is None else rights)
    try:
        yield part
        with part.open("rb") as written:
            os.fsync(written.fileno())
        mode = _mode(target)
        if rights is None and mode is not None:
            part.chmod(stat.S_IMODE(mode))
        part.replace(target)
    except OSError as error:
        if error.errno not in FULL:
            raise
        problem = f"{path}: writing failed: {error.strerror}; free some space"
        raise CangaugeError(problem) from error
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def write_text_atomic(path: str | PathLike[str], text: str, rights: int | None = None) -> None:
    """Write `text` as UTF-8 to `path`, all or nothing (see `atomic_path`)."""
    with atomic_path(path, rights) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def write_texts_atomic(texts: Mapping[Path, str]) -> None:
    """Write several files as UTF-8, all or none (see `atomic_path`)."""
    with ExitStack() as stack:
        for path, text in texts.items():
            part = stack.enter_context(atomic_path(path))
            part.write_text(text, encoding="utf-8", newline="\n")


def check_writable(path: str | PathLike[str]) -> None:
    """Raise the InputError that writing `path` would raise, before any long work is done."""
    refuse_foreign(path)
    if not _is_device(Path(path)):
        _create_beside(Path(os.path.realpath(path)), shown=path).unlink()


def require_suffix(path: str | PathLike[str], *suffixes: str, field: str) -> None:
    """Raise InputError unless a file to write has one of these suffixes, or is a device.

    Parameters
    ----------
    path : path-like
    *suffixes : str
        With their dot, in lower case.
    field : str
        Option or field that names it, for the message.
    """
    output = Path(path)
    if output.suffix.lower() in suffixes or _is_device(output):
        return
    names = " or ".join(part for part in (", ".join(suffixes[:-1]), suffixes[-1]) if part)
    raise InputError(
        f"the suffix is not {names}",
        source=output,
        field=field,
        value=output.suffix,
        cure=f"name a {names} file",
    )


def refuse_pipe(path: str | PathLike[str]) -> None:
    """Raise InputError for a pipe that a service would write: whoever reads it could stop it.

    A command may write one: Ctrl-C ends it.
    """
    if stat.S_ISFIFO(_mode(Path(path)) or 0):
        raise InputError(
            "this is a pipe (FIFO): whoever reads it could stop the service",
            source=path,
            cure="name a file",
        )


@contextmanager
def sole_writer(path: str | PathLike[str]) -> Iterator[None]:
    """Hold a file for this process while the block runs.

    A lock on a file beside it, which the kernel releases at the latest when the process ends. Where
    there can be no lock (a read-only or full disk, a network file system without locks, Windows)
    the block runs without.

    Raises
    ------
    InputError
        If another process holds it; names that process.
    """
    if fcntl is None:
        yield
        return
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{target.name[:200]}.lock")
    held = _locked(lock, path)
    try:
        yield
    finally:
        if held is not None:
            with suppress(OSError):
                lock.unlink()
            os.close(held)


def _locked(lock: Path, shown: str | PathLike[str]) -> int | None:
    """Return the descriptor of a locked file; None where there can be none."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    while True:
        try:
            held = os.open(lock, flags, PRIVATE)
        except OSError as error:
            if error.errno in _NO_LOCK:
                return None
            raise InputError(
                f"cannot be locked: {lock.name}: {error.strerror}",
                source=shown,
                cure="remove that file, or name another one",
            ) from error
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last holder may have removed it between both calls.
            if os.path.samestat(os.fstat(held), lock.lstat()):
                with suppress(OSError):
                    os.ftruncate(held, 0)
                    os.write(held, f"{os.getpid()}\n".encode())
                return held
        except BlockingIOError as error:
            holder = os.read(held, 20).decode("ascii", "replace").strip()
            os.close(held)
            raise InputError(
                f"another service{f' (process {holder})' if holder else ''} writes this file",
                source=shown,
                cure="stop that one, or name another file",
            ) from error
        except FileNotFoundError:
            pass
        except OSError as error:
            os.close(held)
            if error.errno in _NO_LOCK:
                return None
            raise
        os.close(held)


_NO_LOCK: Final = FULL | {
    errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP,
    errno.ENOENT, errno.ENOTDIR, errno.EINVAL,
}  # fmt: skip
"""Errors of places without locks; where nothing can be written at all, writing reports it."""


def refuse_foreign(path: str | PathLike[str]) -> None:
    """Raise InputError if writing `path` would write what somebody else chose.

    In a folder such as `/tmp` (sticky, writable by all) anybody can place a link or pipe under a
    name that is written later. As Linux does for opening a file (`fs.protected_symlinks`,
    `fs.protected_fifos`), a link is followed and a pipe written there only if it belongs to this
    user or to the folder's owner. A file that is renamed into place never meets those checks.
    Disks and sockets, which no file can replace, are refused everywhere.
    """
    if not hasattr(os, "geteuid"):  # Windows
        return
    rest = list(Path(path).parts)
    place = Path("/" if Path(path).is_absolute() else ".")
    for _ in range(_MOST_PARTS):
        if not rest:
            return
        name = rest.pop(0)
        if name == "..":
            place = place / ".." if place.name in {"", ".."} else place.parent
            continue
        found = place / name  # an absolute path begins with its root
        try:
            state, folder = found.lstat(), place.lstat()
            target = found.readlink() if stat.S_ISLNK(state.st_mode) else None
        except (OSError, ValueError):
            return  # absent, or impossible: creating it reports which
        if target is not None:
            _refuse_planted(state, folder, "a symbolic link", path)
            rest = [*target.parts, *rest]
            continue
        if not rest and stat.S_ISFIFO(state.st_mode):
            _refuse_planted(state, folder, "a pipe (FIFO)", path)
        if not rest and (stat.S_ISBLK(state.st_mode) or stat.S_ISSOCK(state.st_mode)):
            kind = "a disk" if stat.S_ISBLK(state.st_mode) else "a socket"
            raise InputError(f"this is {kind}, not a file", source=path, cure="name a file")
        place = found


_MOST_PARTS: Final = 4096
"""Most parts of a path, with those of the links in it: a circle of links ends here."""


def _refuse_planted(
    state: os.stat_result, folder: os.stat_result, kind: str, path: str | PathLike[str]
) -> None:
    shared = stat.S_ISVTX | stat.S_IWOTH
    if folder.st_mode & shared == shared and state.st_uid not in {os.geteuid(), folder.st_uid}:
        raise InputError(
            f"leads over {kind} that another user placed in a shared folder",
            source=path,
            cure="remove it, or name a file in a folder of your own",
        )


def _is_device(path: Path) -> bool:
    mode = _mode(path)
    return mode is not None and not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except OSError:  # absent, or an impossible path: creating it reports which
        return None


def _create_beside(target: Path, *, shown: str | PathLike[str], rights: int = 0o666) -> Path:
    mode = _mode(target)
    if mode is not None and stat.S_ISDIR(mode):
        raise InputError("this is a folder", source=shown, cure="name a file in it")
    # The suffix stays last: writers such as pyarrow and bokeh choose the format by it.
    part = target.with_name(f".{target.stem[:200]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        with suppress(FileNotFoundError):
            target.lstat()  # its name can be too long where that of `part` is not
        part.touch(rights, exist_ok=False)
    except OSError as error:
        problem, cure = _WRITE_ERRORS.get(
            error.errno or 0, (f"cannot be written: {error.strerror}", "name another path")
        )
        raise InputError(problem, source=shown, cure=cure) from error
    return part


def text_sha256(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: str | Path) -> str | None:
    """Return the SHA-256 of a file's bytes in hexadecimal; None if it is not a file."""
    if not path or not Path(path).is_file():
        return None
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
