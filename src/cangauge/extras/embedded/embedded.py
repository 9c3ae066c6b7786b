"""Export of a model as C sources for a microcontroller: `cangauge export-c`.

The folder holds the core (`core/`), the constants of the model, the frame SOC_ESTIMATE, an example,
and tests against this package on a drive with events.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np

from cangauge._files import make_folder, text_sha256, write_texts_atomic
from cangauge._resources import shared_file
from cangauge._version import __version__
from cangauge.bus.publish import SocPublisher
from cangauge.errors import InputError
from cangauge.estimation.estimator import Estimator
from cangauge.extras.embedded.c_source import (
    CORE_HEADERS,
    CORE_SOURCES,
    CoreConstants,
    TabulatedModel,
    exported_constants,
    initialiser,
    line_size,
    model_definition,
)
from cangauge.extras.embedded.platforms import Platform, arranged
from cangauge.model.model_file import Model
from cangauge.types import Sample

EMBEDDED: Final = (
    "Makefile",
    "frames.c",
    "frames.h",
    "example.c",
    "test.c",
    "clock.h",
    "startup.c",
    "mps2.ld",
)
FOXBMS: Final = ("foxbms_soc.c", "foxbms_soc.h")

PERIOD_S: Final = 0.5
"""Time between two samples that the delay line has memory for [s]: of five drives at 10 Hz the SoC
then differs by at most 0.009 % from that with every sample (at 1 s by 0.015 %)."""

JITTER: Final = 0.9
"""Part of the period from which a sample is kept: a task's jitter stays within a tenth of it."""

WAITING_AT_LEAST: Final = 130
"""Samples that a `time_skew` holds beyond those of its time: twice the stale ones that the core
drops at once (64), and the two of an interpolation."""

GOLDEN_S: Final = 1200.0
"""Duration of the drive of the tests [s]: several times the longest delay of most models."""

FAST_SAMPLES: Final = 200
"""Samples of it that are `period_s` apart."""

_HEAD: Final = "/* {} - of the model "
_MARK: Final = _HEAD.format("pack_model.h")
"""Beginning of a header that shows that a folder is of an export."""


def export_c(
    model: Model, folder: Path, *, period_s: float = PERIOD_S, platform: Platform = "generic"
) -> tuple[list[str], int]:
    """Write the C sources of a model.

    Parameters
    ----------
    model : Model
    folder : Path
        Made if it is missing; files of an earlier export are replaced.
    period_s : float
        Time between two samples of the current [s]. More samples are taken too, but the delay line
        then keeps some of them only.
    platform : {"generic", "esp-idf", "zephyr", "arduino", "foxbms"}
        What the folder is to be: sources with a Makefile, or what a platform builds (`platforms`).

    Returns
    -------
    list of str, int
        Names of the files, and memory of the delay line with floats [B].

    Raises
    ------
    InputError
        If the core lacks one of the model's effects.
        If the folder has a file of the same name that is not of an export.
        If the folder cannot be made.
    """
    model = TabulatedModel.of(model)
    constants = exported_constants(model)
    spacing_s = JITTER * 2.0 * period_s
    length = line_size(constants, spacing_s)
    head = f"{_HEAD}{_comment(model.name)}, by cangauge {__version__}. */\n"
    folders = dict.fromkeys(CORE_HEADERS + CORE_SOURCES, "core")
    folders |= dict.fromkeys(EMBEDDED + FOXBMS * (platform == "foxbms"), "core/embedded")
    texts = {
        name: shared_file(place, name).read_text(encoding="utf-8")
        for name, place in folders.items()
    }
    definition = model_definition("pack_model", constants)
    identity = text_sha256("".join(texts.values()) + definition)
    made = {
        "cangauge_config.h": _config(constants, period_s),
        "pack_model.h": _model_header(length, spacing_s, identity),
        "pack_model.c": f'#include "pack_model.h"\n\n#include <math.h>\n\n{definition}',
        "golden.h": _golden(model, period_s),
    }
    texts |= {name: head.format(name) + text for name, text in made.items()}
    texts = arranged(platform, texts)
    _refuse_foreign_names(folder, texts)
    try:
        for parent in {(folder / name).parent for name in texts}:
            make_folder(parent)
    except OSError as error:
        problem = f"this folder cannot be made: {error.strerror}"
        raise InputError(problem, field="--output", value=str(folder)) from error
    write_texts_atomic({folder / name: text for name, text in texts.items()})
    return sorted(texts), 8 * length


def std_at_rest_pct(model: Model) -> float:
    """Return the deviation of a SoC near 50 % that the voltage of a rest gives [%]."""
    estimator, voltage = Estimator(model), model.voltage_model()
    std_pct, second = math.nan, 0
    while second <= model.noise.block_s or math.isnan(std_pct):  # a time skew ends a block later
        estimator.update(Sample(float(second), 0.0, voltage.nominal_v, voltage.loads.t_ref_c))
        std_pct, second = estimator.estimate.soc_std_pct, second + 1
    return std_pct


def _refuse_foreign_names(folder: Path, names: Iterable[str]) -> None:
    """Raise InputError for a folder that has files of these names, but not from an export."""
    taken = sorted(name for name in names if os.path.lexists(folder / name))
    headers = [folder / name for name in names if name.endswith("pack_model.h")]
    if not taken or any(h.is_file() and h.read_bytes().startswith(_MARK.encode()) for h in headers):
        return
    raise InputError(
        "the folder has files of these names that are not from an export",
        source=folder,
        value=taken,
        cure="name an empty folder",
    )


def _comment(text: str) -> str:
    """Return a text that cannot end a comment."""
    return "".join(each if each.isalnum() or each in " .-_" else "_" for each in text)


def _config(constants: CoreConstants, period_s: float) -> str:
    """Return the sizes of the structures."""
    of = constants.model
    waiting = math.ceil(abs(of["skew_s"]) / period_s) + WAITING_AT_LEAST if of["skew_s"] else 1
    sizes = {name: of[name] for name in ("delays", "low_passes", "functions", "effects")}
    sizes |= {"knots": max(of["knots"], of["function_knots"]), "waiting": waiting}
    lines = [f"#define CG_{name.upper()} {max(size, 1)}" for name, size in sizes.items()]
    return "\n".join(lines) + "\n"


def _model_header(length: int, spacing_s: float, sha256: str) -> str:
    return f"""#ifndef PACK_MODEL_H
#define PACK_MODEL_H

#include "cangauge.h"

/* Memory of the delay line, and least time between every second sample that it keeps. */
#define PACK_LINE_SIZE {length}
#define PACK_SPACING_S {spacing_s!r}

/* Of the constants and of the core: a saved state is of no other model. Not 0. */
#define PACK_MODEL_ID 0x{int(sha256[:8], 16) | 1:08x}U

extern const cg_model pack_model;

#endif
"""


def _golden(model: Model, period_s: float) -> str:
    """Return the drive of the tests, and what this package estimates on it.

    A frame holds the numbers rounded to floats, so that both precisions of the core pack the same.
    """
    reference, publisher = Estimator(model), SocPublisher()
    rows: list[str] = []
    for sample in drive_with_events(model, period_s):
        found = reference.step(sample)
        flags = int(found.status), f"{int(found.reasons)}U"
        packed = np.array(found[1:3], dtype=np.float32).tolist()
        rounded = found._replace(soc_pct=packed[0], soc_std_pct=packed[1])
        frame = list(publisher.estimate_frame(rounded).data)
        row = [*sample, list(found[1:5]), *flags, packed, frame]
        rows.append(f"    {initialiser(row, 'golden')},\n")
    head = f"#define GOLDEN_SAMPLES {len(rows)}\nstatic const golden golden_samples[] = {{\n"
    return f"{head}{''.join(rows)}}};\n"


def drive_with_events(model: Model, period_s: float) -> Iterator[Sample]:
    """Yield a drive of the model's own pack with a gap, missing signals and an unobserved interval.

    Numbers are those of a float, so that both precisions of the core read the same.
    """
    voltage = model.voltage_model()
    low, high = voltage.range.soc_pct
    soc_pct, capacity_ah = 0.25 * low + 0.75 * high, model.capacity_ah
    usual_s = max(period_s, 1.0 / model.rate_hz)
    steps = int(GOLDEN_S / usual_s)
    time_s = 0.0
    for k in range(steps):
        # A few at the rate of the current, the others at that of the voltage.
        spacing_s = period_s if k < FAST_SAMPLES else usual_s
        time_s += spacing_s
        time_s += {steps // 3: 7.0, 2 * steps // 3: 5400.0}.get(k, 0.0)
        # Load steps of 20 s between a quarter of 1 C in and 1 C out.
        rate = (0.2, 0.9, -0.25, 0.4, 0.0)[int(time_s / 20.0) % 5]
        current_a = rate * capacity_ah
        soc_pct -= 100.0 * current_a * spacing_s / (3600.0 * capacity_ah)
        error_v = 5e-4 * voltage.nominal_v * math.sin(0.7 * k)
        volts = voltage.pseudo_ocv_at(soc_pct)[0] + error_v
        volts += sum(voltage.loads.resistance_ohm) * current_a
        temperature_c = voltage.loads.t_ref_c + 3.0 * math.sin(k / 400.0)
        if k % 97 == 5:
            volts = math.nan
        if k % 61 == 3:
            temperature_c = math.nan
        if k % 301 == 7:
            volts = 0.0
        yield Sample(time_s, *(_as_float(each) for each in (current_a, volts, temperature_c)))


def _as_float(value: float) -> float:
    """Return the number with the precision of a sensor: 1/1024."""
    return value if math.isnan(value) else round(value * 1024.0) / 1024.0
