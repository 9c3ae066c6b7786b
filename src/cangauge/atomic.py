"""Writing files so that nothing half-written is ever left under the wanted name."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cangauge.errors import CangaugeError, InputError

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""Errors of a disk that is full or fails, which pass."""
_CURES: dict[int, tuple[str, str]] = {
    errno.ENOENT: ("the folder of this file does not exist", "create it or name another one"),
    errno.ENOTDIR: ("a part of this path is a file, not a folder", "name another path"),
    errno.EACCES: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EPERM: ("the folder of this file is not writable", "change its rights or name another"),
    errno.EROFS: ("the file system is read-only", "name another folder"),
    errno.ENAMETOOLONG: ("the file name is too long", "name a shorter one"),
}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it there if the block ends well.

    The temporary file exists (empty), is on the same file system and keeps the suffix. When the
    block raises, it is removed and whatever stood at `path` before is untouched. The contents are
    on the disk before the name changes, so that a power cut leaves the old file or the new one.
    A device or pipe (`/dev/stdout`) cannot be replaced and is yielded as it is.

    Parameters
    ----------
    path : path-like
        The file to write; a symbolic link is followed.

    Yields
    ------
    Path
        Where to write.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or `path` is a folder.
    CangaugeError
        If the disk is full or fails while writing.
    """
    target = Path(path)
    if _is_device(target):
        yield target
        return
    target = Path(os.path.realpath(target))
    part = _new_beside(target, shown=path)
    try:
        yield part
        _to_disk(part)
        mode = _mode(target)
        if mode is not None:
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


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 at `path`, all or nothing (see `atomic_path`)."""
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise the InputError that writing `path` would raise, before any long work is done."""
    if not _is_device(Path(path)):
        _new_beside(Path(os.path.realpath(path)), shown=path).unlink()


def _is_device(path: Path) -> bool:
    mode = _mode(path)
    return mode is not None and not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except OSError:  # absent, or a path that cannot be: creating it will say which
        return None


def _new_beside(target: Path, *, shown: str | os.PathLike[str]) -> Path:
    mode = _mode(target)
    if mode is not None and stat.S_ISDIR(mode):
        raise InputError("this is a folder", source=shown, cure="name a file in it")
    # The suffix stays last: writers such as pyarrow and bokeh choose by it.
    part = target.with_name(f".{target.stem[:200]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        part.touch(exist_ok=False)
    except OSError as error:
        problem, cure = _CURES.get(
            error.errno or 0, (f"cannot be written: {error.strerror}", "name another path")
        )
        raise InputError(problem, source=shown, cure=cure) from error
    return part


def _to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
