"""Build hook: the C core as the extension `cangauge._core`, where there is a compiler.

Without one, or with `CANGAUGE_PURE_PYTHON` set, the wheel is pure Python: slower, the same numbers.
Run as a script, it builds the extension in place, for a checkout that was installed editable.
"""

from __future__ import annotations

import os
import runpy
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run as a script, outside of a build
    BuildHookInterface = object  # type: ignore[assignment, misc]

# Every operation is rounded by itself, as in Python: no fused multiply-add.
FLAGS = ("-std=c99", "-O3", "-fPIC", "-ffp-contract=off")


def linker() -> list[str]:
    """Return the command that links an extension: `LDSHARED`, with the compiler in `CC`."""
    usual = shlex.split(sysconfig.get_config_var("LDSHARED") or "")
    if "LDSHARED" in os.environ or "CC" not in os.environ:
        return shlex.split(os.environ.get("LDSHARED", "")) or usual
    return [*shlex.split(os.environ["CC"]), *usual[1:]]


def build_extension(root: Path, folder: Path) -> Path | None:
    """Compile the extension into a folder; None, and none there, if that is not possible."""
    core, include = root / "core", Path(sysconfig.get_paths()["include"])
    target = folder / f"_core{sysconfig.get_config_var('EXT_SUFFIX')}"
    target.unlink(missing_ok=True)
    if not linker() or not (include / "Python.h").is_file():
        return None
    digest = runpy.run_path(str(root / "src/cangauge/_core_digest.py"))["sources_digest"](core)
    command = [
        *linker(), *FLAGS, f'-DCG_SOURCES="{digest}"',
        f"-I{include}", f"-I{core}", *map(str, sorted(core.glob("*.c"))), "-lm", "-o", str(target),
    ]  # fmt: skip
    try:
        subprocess.run(command, check=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"cangauge: without the compiled core ({error})", file=sys.stderr)
        return None
    return target


class CoreBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the extension to the wheel."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build into the sources of an editable installation, else into the wheel."""
        if os.environ.get("CANGAUGE_PURE_PYTHON"):
            return
        root = Path(self.root)
        is_editable = version == "editable"
        self.temporary = tempfile.TemporaryDirectory()  # until the wheel holds the extension
        folder = root / "src" / "cangauge" if is_editable else Path(self.temporary.name)
        built = build_extension(root, folder)
        if built is None:
            return
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
        if not is_editable:
            build_data["force_include"][str(built)] = f"cangauge/{built.name}"


if __name__ == "__main__":
    here = Path(__file__).parent
    sys.exit(build_extension(here, here / "src" / "cangauge") is None)
