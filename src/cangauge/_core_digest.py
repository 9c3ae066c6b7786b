"""Digest of the core's sources, which the compiled core carries."""

import hashlib
from pathlib import Path


def sources_digest(core: Path) -> str:
    """Return the digest of the sources in a folder."""
    content = b"".join(each.read_bytes() for each in sorted(core.glob("*.[ch]")))
    return hashlib.sha256(content).hexdigest()[:16]
