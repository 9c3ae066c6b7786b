"""Wrong and VALID: how often an estimate of a wrong model or sensor looks sound.

    cd benchmarks && python wrong_models.py [--data FOLDER] [--draws 3] [--logs 8]

Models of five drawn logs of a recorded pack estimate other logs of it, with something wrong: the
model is another pack's, its capacity or the current's gain is off, or the pack is colder than any
log of the model. With the start withheld and given (1 %). Shares are of all samples.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table

import cangauge
from cangauge.types import Status
from figures import publish
from packs.recorded import Pack, load

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
TRAINING = 5
OTHER = {"i3": "lg_hg2", "lg_hg2": "i3", "car1": "i3"}
"""The pack that a wrong model is of."""


def fitted(pack: Pack, seed: int) -> tuple[cangauge.Model, list[cangauge.Log]]:
    """Return the model of drawn logs, and the logs that it has not seen."""
    rng = np.random.default_rng(seed)
    size = min(TRAINING, len(pack.training) - 1)
    chosen = [pack.training[k] for k in rng.permutation(len(pack.training))[:size]]
    names = {log.name for log in chosen}
    model = cangauge.fit(
        chosen, capacity_ah=pack.capacity_of(chosen), chemistry=pack.chemistry, cells=pack.cells
    ).model
    return model, [log for log in pack.judged if log.name not in names]


def cases(
    model: cangauge.Model, other: cangauge.Model, log: cangauge.Log, cold: cangauge.Log | None
) -> list[tuple[str, cangauge.Model, cangauge.Log]]:
    """Return what is wrong, with the model and the log that the estimator gets."""
    small = model.model_copy(update={"capacity_ah": 0.6 * model.capacity_ah})
    found = [
        ("none", model, log),
        ("another pack's model", other, log),
        ("capacity −40 %", small, log),
        ("current +10 %", model, replace(log, current_a=1.1 * log.current_a)),
    ]
    return found + ([("0 °C, model of 25 °C", model, cold)] if cold is not None else [])


def figures(log: cangauge.Log, model: cangauge.Model, start: float | str) -> dict[str, float]:
    """Return the shares of an estimate."""
    table = cangauge.estimate(replace(log, soc_pct=None), model, initial_soc_pct=start)
    error = np.abs(np.asarray(table.soc_pct) - log.soc_pct)
    valid = np.asarray(table.status) == Status.VALID
    invalid = np.flatnonzero(np.asarray(table.status) == Status.INVALID)
    std = np.asarray(table.soc_std_pct)
    with np.errstate(invalid="ignore"):
        within, beyond = error <= 2.0 * std, error > 3.0 * std
    first_s = log.time_s[invalid[0]] - log.time_s[0] if invalid.size else np.inf
    return {
        "valid": float(valid.mean()),
        "wrong": float((valid & beyond).mean()),
        "within": float(within[valid].mean()) if valid.any() else np.nan,
        "invalid_min": first_s / 60.0,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--logs", type=int, default=8, help="of each draw")
    parser.add_argument("--keep", action="store_true", help="keep the figures for the page")
    options = parser.parse_args()
    packs = {pack.name: pack for pack in load(options.data, [*OTHER, "lg_hg2_from_25c"])}
    rows: dict[tuple[str, str, str], list[dict[str, float]]] = defaultdict(list)
    for name, other_name in OTHER.items():
        for draw in range(options.draws):
            model, logs = fitted(packs[name], draw)
            other, _ = fitted(packs[other_name], draw)
            cold = packs["lg_hg2_from_25c"].judged if name == "lg_hg2" else []
            for k, log in enumerate(logs[: options.logs]):
                colder = cold[k] if k < len(cold) else None
                for what, its_model, seen in cases(model, other, log, colder):
                    for start, words in (("auto", "withheld"), (float(seen.soc_pct[0]), "given")):
                        rows[name, what, words].append(figures(seen, its_model, start))
    heads = (
        "pack",
        "error",
        "initial SoC",
        "drives",
        "time VALID",
        "time VALID and off by > 3σ",
        "VALID estimates within 2σ",
        "drives with INVALID",
        "first INVALID after (median)",
    )
    table = Table(*heads)
    for (name, what, start), found in rows.items():
        mean = {key: np.nanmean([each[key] for each in found]) for key in ("valid", "wrong")}
        within = [each["within"] for each in found if not np.isnan(each["within"])]
        ends = [each["invalid_min"] for each in found if np.isfinite(each["invalid_min"])]
        table.add_row(
            name, what, start, str(len(found)), f"{100 * mean['valid']:.0f} %",
            f"{100 * mean['wrong']:.1f} %",
            f"{100 * np.mean(within):.0f} %" if within else "–",
            str(len(ends)), f"{np.median(ends):.0f} min" if ends else "–",
        )  # fmt: skip
    describes = [f"src/cangauge/{name}" for name in ("model", "identify", "estimation")]
    publish("wrong-models", [table], describes, keeps=options.keep)


if __name__ == "__main__":
    main()
