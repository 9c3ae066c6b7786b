"""How large the gap is: in volts and in % SoC, against the two floors."""

from __future__ import annotations

import numpy as np

from cangauge.gap.diagnose import Diagnosis
from cangauge.report.bars import bars
from cangauge.report.figures import BLUE, GREEN, GREY, ORANGE
from cangauge.report.page import Block, Figure, Table
from cangauge.report.words import number


def size_blocks(diagnosis: Diagnosis, extended: str) -> list[Block]:
    """Return the gap's size as bars and as a table.

    Parameters
    ----------
    diagnosis : Diagnosis
    extended : str
        What the extended model adds, in words.
    """
    slope = slope_v_per_pct(diagnosis)
    entries = [
        ("model as given", diagnosis.baseline_rmse_v, ORANGE,
         diagnosis.baseline_soc_mae_pct, "these logs"),
        (extended, diagnosis.extended_rmse_v, BLUE,
         diagnosis.extended_soc_mae_pct, "these logs, rows that its fit did not see"),
        (_floor_name(diagnosis), diagnosis.floor_v, GREY, None, _floor_words(diagnosis)),
    ]  # fmt: skip
    if diagnosis.explainable_v is not None:
        entries.append(
            ("floor: explainable", diagnosis.explainable_v, GREEN, None,
             "a reference left out, with the structure that the others teach")
        )  # fmt: skip
    rows = [
        [name, number(volts, 2), number(volts / slope, 2), number(soc, 2), judged]
        for name, volts, _, soc, judged in entries
    ]
    return [
        Figure(
            "Error and floors",
            bars("RMS error", "V", [(name, volts, color) for name, volts, color, _, _ in entries]),
            _see(diagnosis),
        ),
        Table(
            ["", "RMS [V]", "as SoC [%]", "SoC error of the estimator [%]", "judged on"],
            rows,
            note=f"As SoC: volts over the median slope of the pseudo-OCV here,"
            f" {slope:.2f} V per %. The estimator's is the mean absolute error of the EKF with the"
            " initial SoC withheld, after 5 minutes; – where the logs do not tell their SoC.",
        ),
    ]


def slope_v_per_pct(diagnosis: Diagnosis) -> float:
    """Return the median slope of the pseudo-OCV over the diagnosed rows [V per %]."""
    settled = diagnosis.settled
    soc = np.concatenate([terms.prepared.rows.soc_pct for terms in settled.diagnosed])
    return float(np.median(settled.as_given.model.pseudo_ocv_slope(soc)))


def _floor_name(diagnosis: Diagnosis) -> str:
    return "floor: references" if diagnosis.settled.references else "floor: model file"


def _floor_words(diagnosis: Diagnosis) -> str:
    if diagnosis.settled.references:
        return "references, with the model as given: sensors and what repeats no better"
    return "what the model file states, for want of references"


def _see(diagnosis: Diagnosis) -> str:
    times = diagnosis.baseline_rmse_v / max(diagnosis.floor_v, 1e-9)
    words = f"The model's error here is {times:.1f} times that on the references."
    if not diagnosis.settled.references:
        words = f"The model's error here is {times:.1f} times what its file states."
    if diagnosis.explainable_v is None:
        return words + " The second floor, what flexible structure explains, needs more references."
    return (
        words
        + " What lies above both floors is the gap; between them, structure that the model lacks"
        " would explain it without any cause."
    )
