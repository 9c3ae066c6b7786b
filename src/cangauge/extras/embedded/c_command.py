"""`cangauge export-c`: write a model as C sources for a microcontroller."""

from __future__ import annotations

import os
from pathlib import Path

from cangauge._files import check_writable
from cangauge.cli.declare import command
from cangauge.cli.options import check_outputs
from cangauge.cli.output import emit_json, note
from cangauge.errors import InputError


def _check_folder(folder: Path) -> None:
    """Refuse, before any long work, a folder that is a file or cannot be made."""
    if os.path.isdir(folder):  # noqa: PTH112 - False, not an error, for a name too long
        return
    if os.path.exists(folder):  # noqa: PTH110 - likewise
        raise InputError("is a file", field="--output", value=str(folder), cure="name a folder")
    made = folder
    while not os.path.exists(made.parent):  # noqa: PTH110 - likewise
        made = made.parent
    check_writable(made)


@command()
def export_c_command(
    *, model: Path, output: Path, period: float = 0.1, json_output: bool = False
) -> None:
    """Write a model and the estimator as C sources, with tests, for a microcontroller.

    Examples
    --------
    `cangauge export-c -m pack.json -o pack_c`

    Parameters
    ----------
    output : -o, --output DIR
        Folder for the sources: empty, of an earlier export, or made.
    period : S
        Time between two samples of the current [s].
    """
    _check_folder(output)
    if os.path.isdir(output):  # noqa: PTH112 - pathlib raises for an impossible name
        check_outputs([output / "pack_model.c"], [model])
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.embedded import export_c
    from cangauge.model.model_file import Model

    done = export_c(Model.load(model), output, period_s=period)
    if json_output:
        emit_json({
            "folder": str(done.folder),
            "files": list(done.files),
            "delay_line_bytes": done.delay_line_bytes,
        })  # fmt: skip
        return
    files = f"{len(done.files)} files in {done.folder}"
    note(f"{files}: `make test` there runs the tests on this machine.")
    note(f"The delay line takes {done.delay_line_bytes / 1024:.1f} KiB at {period:g} s a sample.")
