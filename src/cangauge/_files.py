"""Files: recognise them by their beginning, read them unpacked, write them all or nothing.

A file that the user names may be damaged, huge or mislabelled. It meets a limit of its size and
one clear error; nothing is lost when writing fails.
"""

from __future__ import annotations

import bz2
import codecs
import errno
import glob
import gzip
import hashlib
import io
import os
import re
import secrets
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from copy import copy
from os import PathLike
from pathlib import Path
from typing import BinaryIO, Final, Self, cast

from cangauge.errors import CangaugeError, InputError

MIB: Final = 1 << 20
MAX_LOG_BYTES: Final = 1024 * MIB
"""A log, unpacked: it is held in memory."""
HEAD_BYTES: Final = 64 * 1024
_HEAD_LINES: Final = 160

# --- Reading

_DAMAGE: Final = (EOFError, OSError, ValueError, zlib.error, zipfile.BadZipFile)
_GZIP = b"\x1f\x8b"
_BZIP2 = b"BZh"
_ZIP = b"PK\x03\x04"


def _at_any_bit(mark: int) -> list[bytes]:
    """Return the whole bytes of a mark of 48 bits, by the bit of a byte at which it begins."""
    return [(mark << 8 >> bit).to_bytes(7, "big")[1:6] for bit in range(8)]


_BZIP2_BLOCK: Final = _at_any_bit(0x314159265359)
_BZIP2_END: Final = _at_any_bit(0x177245385090)
_UTF16: Final = (b"\xff\xfe", b"\xfe\xff")
_D3_MEMBER: Final = "test data.txt"
_SUFFIX: Final = re.compile("gz|bz2|zip|csv|txt|tsv|parquet|pq|dat|xlsx|mpt|bdf|mf4", re.IGNORECASE)


def as_path(path: object) -> Path:
    """Return a path; raise InputError if the object is none."""
    if isinstance(path, str | os.PathLike):
        return Path(os.fspath(path))
    raise InputError("not a path", value=type(path).__name__, cure="give the path of a file")


def open_regular(path: str | PathLike[str]) -> BinaryIO:
    """Open a file for reading; InputError if it is absent, no regular file, or unreadable."""
    path = as_path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError("this is a folder, not a file", source=path, cure="name a file in it")
        if not stat.S_ISREG(mode):
            kind = "a pipe (FIFO)" if stat.S_ISFIFO(mode) else "a device"
            raise InputError(
                f"this is {kind}, not a file", source=path, cure="save its content as a file"
            )
        return path.open("rb")
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise _unreadable(error, path) from error


def _unreadable(error: OSError | ValueError, path: str | PathLike[str]) -> InputError:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return InputError("no such file", source=path, cure="check the path")
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(
        f"cannot be read: {reason}",
        source=path,
        cure="change its rights" if isinstance(error, PermissionError) else "check the path",
    )


def open_unpacked(path: str | PathLike[str]) -> io.BufferedReader:
    """Open a file for reading; gzip and bzip2 are recognised by content and unpacked.

    A damaged packed file raises `EOFError`, `OSError` or `zlib.error` while it is read.
    """
    file = cast("io.BufferedReader", open_regular(path))
    begin = file.peek(3)
    for mark, module in ((_GZIP, gzip), (_BZIP2, bz2)):
        if begin.startswith(mark):
            file.close()
            return cast("io.BufferedReader", module.open(path))
    return file


def read_beginning(file: io.BufferedReader, size: int) -> bytes:
    """Return at most `size` bytes from an open file; fewer where it is damaged or ends."""
    beginning = bytearray()
    with suppress(*_DAMAGE):
        while len(beginning) < size and (part := file.read1(size - len(beginning))):
            beginning += part
    return bytes(beginning)


def read_all(file: BinaryIO, path: str | PathLike[str], limit: int, what: str) -> bytes:
    """Return the rest of an open file; raise InputError if it has more than `limit` bytes.

    The limit of a bzip2 file is a quarter as large, because it unpacks at most a quarter as fast.
    """
    if isinstance(file, bz2.BZ2File):
        limit //= 4
    if _stated_bytes(file, path) > limit:
        raise _too_large(path, limit, what)
    content = io.BytesIO()  # grows in place: pieces, joined at the end, take the memory twice
    while content.tell() <= limit and (piece := file.read(min(limit + 1, MIB))):
        content.write(piece)
    if content.tell() > limit:
        raise _too_large(path, limit, what)
    return content.getvalue()


def _stated_bytes(file: BinaryIO, path: str | PathLike[str]) -> int:
    """Return the size that an open file states, unpacked; 0 if it states none."""
    if isinstance(file, bz2.BZ2File):
        return _bzip2_bytes(path)
    if type(file) not in {io.BufferedReader, gzip.GzipFile}:
        return 0
    size = os.fstat(file.fileno()).st_size
    if isinstance(file, gzip.GzipFile):
        with Path(path).open("rb") as packed:
            packed.seek(-min(size, 4), io.SEEK_END)
            stated = int.from_bytes(packed.read(4), "little")
        # What packs better is quickly unpacked; and a cut file ends in any number.
        size = stated if stated <= 30 * size else 0
    return size


def _bzip2_bytes(path: str | PathLike[str]) -> int:
    """Return the least size that a bzip2 file can have when unpacked.

    A full block of level n has n × 100,000 bytes, with a count behind every four equal ones: it
    unpacks to 80 % of them or more. Blocks and ends of streams begin with a mark, at any bit. The
    last block of a stream is not full.
    """
    full = 0
    with Path(path).open("rb") as packed:
        level = packed.read(4)[3:].decode("latin-1")
        begin = b""
        while piece := packed.read(MIB):
            piece = begin + piece
            full += sum(piece.count(mark) for mark in _BZIP2_BLOCK)
            full -= sum(piece.count(mark) for mark in _BZIP2_END)
            begin = piece[1 - len(_BZIP2_END[0]) :]
    return full * 80_000 * int(level) if level.isdecimal() else 0


def _too_large(path: str | PathLike[str], limit: int, what: str) -> InputError:
    size = f"{limit // MIB} MB" if limit >= MIB else f"{limit // 1024} kB"
    return InputError(
        f"larger than the {size} that {what} may have",
        source=path,
        cure="check that this is the right file, and that it is whole; or split it",
    )


def read_bounded(path: str | PathLike[str], limit: int, what: str) -> bytes:
    """Return the content of a file of at most `limit` bytes; `what` names its kind in errors."""
    try:
        with open_regular(path) as file:
            return read_all(file, path, limit, what)
    except OSError as error:
        raise _unreadable(error, path) from error


_CHINESE: Final = re.compile(rb"(?s)(?=.*[\xa1-\xf7]{4})(?:[\x00-\x7f]|[\xa1-\xf7][\xa1-\xfe])*+")
"""GB 2312: bytes above ASCII in pairs, and words of two characters or more."""


def as_utf8(data: bytes) -> bytes:
    """Return text of UTF-8, UTF-16, GB 18030 or latin-1 as UTF-8 without a byte order mark."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if data[:2] in _UTF16:
        return data.decode("utf-16", errors="replace").encode()
    for first, codec in ((1, "utf-16-le"), (0, "utf-16-be")):  # without a mark: every second byte
        halves = data[first:HEAD_BYTES:2]
        zeros = halves.count(0)
        if 2 * zeros > len(halves) and data[:HEAD_BYTES].count(0) == zeros:
            return data.decode(codec, errors="replace").encode()
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:  # in pieces, as the text of a large file takes memory
        for place in range(0, len(data), MIB):
            decoder.decode(data[place : place + MIB], final=place + MIB >= len(data))
    except UnicodeDecodeError:
        head = data[: data.rfind(b"\n", 0, HEAD_BYTES) + 1]
        codec = "gb18030" if _CHINESE.fullmatch(head) else "latin-1"
        return data.decode(codec, errors="replace").encode()
    return data


class Head:
    """The beginning of a file, by which readers recognise it; the rest on demand.

    gzip, bzip2 and the only file of a zip are unpacked.

    Attributes
    ----------
    path : Path
        As given.
    name : str
        File name without folder and suffixes (of the member, for a zip).
    data : bytes
        The first 64 KiB.
    lines : tuple of str
        The first lines of a text, without line ends; empty for binary content.
    text : bytes or None
        What is read in place of the file's content.
    decimal_mark : str
        Decimal mark of a table whose numbers do not show it; "" if unknown.

    Raises
    ------
    InputError
        If the file is absent, unreadable, empty or damaged from its start, or if a zip holds
        several files.
    """

    text: bytes | None = None
    decimal_mark: str = ""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.name = _stem(self.path.name)
        with self.open() as file:
            self.data = read_beginning(file, HEAD_BYTES)
        if not self.data:
            with self.open() as file:
                file.read(1)  # raises if the file is damaged, not empty
        if not self.data.strip():
            raise InputError("the file is empty", source=self.path, cure="check the export")
        self.lines = _lines(self.data)
        is_cut = len(self.data) == HEAD_BYTES and not {10, 13} & {*self.data}
        if self.lines and is_cut and self.data[:1] not in b"[{<":
            raise InputError(
                f"the first line is longer than {HEAD_BYTES // 1024} kB",
                source=self.path,
                cure="keep the columns of time, current, voltage, temperature and SoC",
            )

    @property
    def first_line(self) -> str:
        """The first line that is not blank; "" for binary content."""
        return next((line for line in self.lines if line.strip()), "")

    @contextmanager
    def open(self) -> Iterator[io.BufferedReader]:
        """Open the unpacked content; damage met while reading is an `InputError`."""
        kind = ""
        try:
            with open_unpacked(self.path) as file:
                kind = "" if isinstance(file, io.BufferedReader) else "packed "
                if not file.peek(len(_ZIP)).startswith(_ZIP):
                    yield file
                    return
                kind = "zip "
                packed = io.BytesIO(read_all(file, self.path, MAX_LOG_BYTES, "a log"))
            with zipfile.ZipFile(packed) as archive:
                if "xl/workbook.xml" in archive.namelist():
                    packed.seek(0)
                    yield cast("io.BufferedReader", packed)
                    return
                member = _only_member(archive, self.path)
                self.name = _stem(Path(member.filename).name)
                if member.file_size > MAX_LOG_BYTES:
                    raise _too_large(self.path, MAX_LOG_BYTES, "a log")
                with archive.open(member) as content:
                    yield cast("io.BufferedReader", content)
        except _DAMAGE as error:
            raise InputError(
                f"the {kind}file is cut off or damaged ({error})",
                source=self.path,
                cure="fetch it again",
            ) from error
        except (RuntimeError, NotImplementedError) as error:  # encrypted; unknown compression
            raise InputError(f"the zip cannot be unpacked: {error}", source=self.path) from error

    def holding(self, text: bytes) -> Self:
        """Return the head of a text that is read in place of the file's content."""
        head = copy(self)
        head.data, head.lines, head.text = text[:HEAD_BYTES], _lines(text[:HEAD_BYTES]), text
        return head

    def read(self) -> bytes:
        """Return the unpacked content; InputError if damaged, or larger than a log may be."""
        if self.text is not None:
            return self.text
        with self.open() as file:
            return read_all(file, self.path, MAX_LOG_BYTES, "a log")


def _only_member(archive: zipfile.ZipFile, path: Path) -> zipfile.ZipInfo:
    files = [  # but those that macOS adds: ".DS_Store", "__MACOSX/._trip.csv"
        info
        for info in archive.infolist()
        if not info.is_dir() and Path(info.filename).name[:1] not in {"", "."}
    ]
    # A vehicle's zip of the ANL D3 data base holds documents beside the test data.
    chosen = [info for info in files if info.filename.lower().endswith(_D3_MEMBER)] or files
    if len(chosen) != 1:
        names = ", ".join(info.filename for info in chosen[:4])
        is_neware = any(info.filename == "data.ndc" for info in chosen)
        raise InputError(
            f"the zip holds {len(chosen)} files ({names})" if chosen else "the zip is empty",
            source=path,
            cure="a Neware .ndax: convert it with NewareNDA: NewareNDA.read(file).to_csv('log.csv')"
            if is_neware
            else "unpack it and name one of them",
        )
    return chosen[0]


def _lines(data: bytes) -> tuple[str, ...]:
    if len(data) >= HEAD_BYTES:
        # The last line may be cut within a character, which would make it look like latin-1.
        data = data[: data.rfind(b"\n") + 1] or data
    text = as_utf8(data).rstrip(b"\0").decode("utf-8", errors="ignore")
    return () if "\x00" in text else tuple(text.splitlines()[:_HEAD_LINES])


def _stem(name: str) -> str:
    # One by one: the name of a member of a zip may have 65,535 bytes, nearly all of them suffixes.
    stem, _, suffix = name.rpartition(".")
    while stem and _SUFFIX.fullmatch(suffix):
        name = stem
        stem, _, suffix = name.rpartition(".")
    return name.removesuffix(" Test Data")


# --- Writing

NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)
"""Flag with which a name is opened, never the file that a link of this name points to."""
LINKS_AT_MOST: Final = 40
"""Links that a path may follow, as in Linux (path_resolution(7))."""
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


@contextmanager
def atomic_path(path: str | PathLike[str], rights: int = 0o666) -> Iterator[Path]:
    """Yield a path for the content of `path`, which is replaced when the block succeeds.

    The yielded path leads to an open file (`/dev/fd/7`) and has no suffix. If the block raises,
    `path` is unchanged. The content is synced to disk before the rename: a power cut leaves the old
    file or the new one. A new file gets `rights` less the umask, an own one keeps its rights. Links
    are followed as by `written_name`. A device or pipe (`/dev/stdout`) cannot be replaced and is
    yielded itself.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or `path` is a folder.
    CangaugeError
        If the disk is full or fails while writing.
    """
    target = written_name(path)
    if is_device(target):
        yield target
        return
    part, descriptor = _create_beside(target, path, rights)
    try:
        with os.fdopen(descriptor, "rb+"):
            # The open file, whose name another user of the folder could exchange for a link.
            opened = Path(f"/dev/fd/{descriptor}")
            yield opened if opened.exists() else part
            _sync(descriptor, target)
            info = os.fstat(descriptor)
        if not has_name(info, part):
            raise InputError(
                "another user has exchanged it meanwhile", source=path, cure="name another folder"
            )
        part.replace(target)
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise CangaugeError(f"{path}: writing failed: {error.strerror}; free some space") from error
    finally:
        with suppress(OSError):
            part.unlink()


def remove_parts(path: str | PathLike[str]) -> None:
    """Remove what a killed process left beside a file that only this process writes."""
    target = written_name(path)
    left = f".{glob.escape(target.stem)}.????????{glob.escape(target.suffix)}"
    for part in target.parent.glob(left):
        with suppress(OSError):
            part.unlink()


def written_name(path: str | PathLike[str]) -> Path:
    """Return the file that writing to `path` replaces.

    Links of this user and of root are followed. The name of another user's link is returned
    itself, as that of a link to itself: writing replaces the link.

    Raises
    ------
    InputError
        If a link that another user made in a folder of a third one leads to the folder.
    """
    found = Path(Path(path).absolute().anchor)
    left = list(Path(path).absolute().parts[:0:-1])
    links = 0
    while left:
        name = found / left.pop()
        if not os.path.islink(name):  # noqa: PTH114 - never raises
            found = found.parent if name.name == ".." else name
            continue
        if not _is_trusted(name, is_folder=bool(left)):
            if not left:
                return name
            raise InputError(
                f"{name} is a link of another user", source=path, cure="name the folder itself"
            )
        links += 1
        if links > LINKS_AT_MOST:
            return Path(path).absolute()
        link = name.readlink()
        if name.exists() and not (found / link).exists():
            return name  # /proc/self/fd/1 may be a link to a pipe, which has no name
        left += link.parts[link.is_absolute() :][::-1]
        found = Path(link.anchor or found)
    return found


def make_folder(path: Path) -> None:
    """Make a folder and those above it, but none through a link of another user (InputError)."""
    written_name(path / "file")
    path.mkdir(parents=True, exist_ok=True)


def is_own(info: os.stat_result) -> bool:
    """Return whether a file belongs to this user or to root; always true on Windows."""
    return not hasattr(os, "geteuid") or info.st_uid in {0, os.geteuid()}


def _is_trusted(link: Path, *, is_folder: bool) -> bool:
    info = link.lstat()
    # As the kernel's protected_symlinks: whoever owns a folder may arrange it.
    return is_own(info) or (is_folder and info.st_uid == link.parent.stat().st_uid)


def has_name(info: os.stat_result, path: Path) -> bool:
    """Return whether an open file still has this name."""
    try:
        return os.path.samestat(info, path.lstat())
    except FileNotFoundError:
        return False


def _create_beside(
    target: Path, shown: str | PathLike[str], rights: int = 0o666
) -> tuple[Path, int]:
    """Return a new temporary file beside the target, and its descriptor."""
    part = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        if target.is_dir() and not target.is_symlink():
            raise InputError("this is a folder", source=shown, cure="name a file in it")
        if os.path.lexists(target) and _is_kept_by_another(target):
            raise InputError("another user has made it", source=shown, cure="name another file")
        mode = 0o600 if target.exists() else rights
        return part, os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)
    except OSError as error:
        problem, cure = _WRITE_ERRORS.get(
            error.errno or 0, (f"cannot be written: {error.strerror}", "name another path")
        )
        raise InputError(problem, source=shown, cure=cure) from error


def _is_kept_by_another(name: Path) -> bool:
    """Return whether a file cannot be replaced: another user's in a folder such as /tmp."""
    info = name.lstat()
    folder = name.parent.stat()
    is_sticky = bool(folder.st_mode & stat.S_ISVTX)
    return is_sticky and os.geteuid() not in {0, info.st_uid, folder.st_uid}


def _sync(written: int, target: Path) -> None:
    """Sync a written file to disk, with the rights of the own file that it replaces."""
    os.fsync(written)
    is_kept = target.is_file() and not target.is_symlink() and is_own(target.stat())
    if is_kept and os.chmod in os.supports_fd:
        os.chmod(written, stat.S_IMODE(target.stat().st_mode))


def is_device(path: Path) -> bool:
    try:
        info = path.lstat()
        target = path.stat()
    except (OSError, ValueError):  # absent, or an impossible path: creating it reports which
        return False
    if not is_own(info) and not stat.S_ISCHR(info.st_mode):  # a planted link or pipe
        return False
    return not stat.S_ISREG(target.st_mode) and not stat.S_ISDIR(target.st_mode)


def write_text_atomic(path: str | PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 to `path`, all or nothing (see `atomic_path`)."""
    write_texts_atomic({Path(path): text})


def write_texts_atomic(texts: Mapping[Path, str]) -> None:
    """Write several files as UTF-8, all or none (see `atomic_path`)."""
    with ExitStack() as stack:
        for path, text in texts.items():
            stack.enter_context(atomic_path(path)).write_text(text, encoding="utf-8", newline="\n")


def check_writable(path: str | PathLike[str]) -> None:
    """Raise the InputError that writing `path` would raise, before any long work is done."""
    target = written_name(path)
    if not is_device(target):
        part, descriptor = _create_beside(target, path)
        os.close(descriptor)
        part.unlink()


def require_suffix(path: str | PathLike[str], *suffixes: str, field: str) -> None:
    """Raise InputError unless a file to write has one of these suffixes, or is a device.

    Suffixes are in lower case, with their dot; `field` is the option that names the file.
    """
    output = Path(path)
    if output.suffix.lower() in suffixes or is_device(output):
        return
    names = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
    raise InputError(
        f"the suffix is not {names}",
        source=output,
        field=field,
        value=output.suffix,
        cure=f"name a {names} file",
    )


def text_sha256(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: str | Path) -> str | None:
    """Return the SHA-256 of a file's bytes in hexadecimal; None if it is not a file."""
    if not Path(path).is_file():
        return None
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
