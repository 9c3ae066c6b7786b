"""`cangauge export-c`: write a model as C sources for a microcontroller."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from cangauge._files import check_writable
from cangauge.cli.options import JsonOption, check_outputs
from cangauge.cli.output import emit_json, note
from cangauge.errors import InputError


def _folder(param: typer.CallbackParam, folder: Path) -> Path:
    """Refuse, before any long work, a folder that is a file or cannot be made."""
    if not os.path.isdir(folder):  # noqa: PTH112 - False, not an error, for a name too long
        if os.path.exists(folder):  # noqa: PTH110 - likewise
            raise InputError(
                "is a file", field=param.opts[-1], value=str(folder), cure="name a folder"
            )
        made = folder
        while not os.path.exists(made.parent):  # noqa: PTH110 - likewise
            made = made.parent
        check_writable(made)
    return folder


def export_c_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file of `cangauge fit`.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            callback=_folder,
            help="Folder for the sources: empty, of an earlier export, or made.",
        ),
    ],
    period: Annotated[
        float, typer.Option(metavar="S", help="Time between two samples of the current [s].")
    ] = 0.1,
    as_json: JsonOption = False,
) -> None:
    """Write a model and the estimator as C sources, with tests, for a microcontroller."""
    if os.path.isdir(output):  # noqa: PTH112 - pathlib raises for an impossible name
        check_outputs([output / "pack_model.c"], [model])
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.embedded import export_c
    from cangauge.model.model_file import Model

    done = export_c(Model.load(model), output, period_s=period)
    if as_json:
        emit_json({
            "folder": str(done.folder),
            "files": list(done.files),
            "delay_line_bytes": done.delay_line_bytes,
        })  # fmt: skip
        return
    files = f"{len(done.files)} files in {done.folder}"
    note(f"{files}: `make test` there runs the tests on this machine.")
    note(f"The delay line takes {done.delay_line_bytes / 1024:.1f} KiB at {period:g} s a sample.")
