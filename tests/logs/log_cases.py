"""One drive of 60 rows, as every kind of file of `cases.toml` holds it."""

from __future__ import annotations

import datetime as dt
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

ROWS = 60
TIME_S = np.arange(ROWS, dtype=float)
CURRENT_A = np.where(TIME_S % 2 == 1.0, 40.0, -10.0)
"""Steps every second, so that the data show the sign; positive = discharge."""
VOLTAGE_V = 380.0 - 0.1 * CURRENT_A
SOC_PCT = 80.0 - 0.1 * TIME_S
START = dt.datetime(2024, 3, 13, 23, 59, 30, tzinfo=dt.UTC)

HERE = Path(__file__).parent
CASES: dict[str, dict[str, Any]] = tomllib.loads((HERE / "cases.toml").read_text("utf-8"))


def row_of(case: dict[str, Any], k: int) -> str:
    """Return a row of a case."""
    i, u, soc = float(CURRENT_A[k]), float(VOLTAGE_V[k]), round(float(SOC_PCT[k]), 1)
    when = START + dt.timedelta(seconds=k)
    template = case["row"]
    if k >= case.get("rows_with_second", ROWS):
        template = template.partition("\n")[0]
    if "decimal" in case:
        template = template.replace("21.5", "21,5")
    values = {
        "t": float(k), "t_ms": 1e3 * k, "h": k / 3600.0, "minutes": k / 60.0, "c": -i, "i": i,
        "i_ma": 1e3 * i, "i_ka": i / 1e3, "c_ma": -1e3 * i, "u": u, "u_mv": 1e3 * u, "soc": soc,
        "f": soc / 100.0, "soc_1e4": 1e4 * soc, "days": 45_364.0 + k / 86_400.0,
        "epoch_s": START.timestamp() + k, "epoch_ms": 1e3 * (START.timestamp() + k),
    }  # fmt: skip
    if "decimal" in case:
        values = {name: str(value).replace(".", ",") for name, value in values.items()}
    german_ma = f"{1e3 * i:,.1f}".translate(str.maketrans(",.", ".,"))
    thousand_ma, thousand_mv = f"{1e3 * i:,.0f}", f"{1e3 * u:,.0f}"
    swiss_ma = thousand_ma.translate(str.maketrans(",-", "'\u2212"))
    hms = f"00:00:{k:02d}"
    values |= {"hms": hms, "when": when, "german_ma": german_ma, "thousand_ma": thousand_ma,
               "thousand_mv": thousand_mv, "swiss_ma": swiss_ma,
               "filetime": int(10_000_000 * (START.timestamp() + k + 11_644_473_600)),
               "net_ticks": int(10_000_000 * (START.timestamp() + k + 62_135_596_800))}  # fmt: skip
    way, way_cn = ("Discharging", "恒流放电") if i > 0.0 else ("Charging", "恒流充电")
    values["flag"] = str(i < 0.0).upper()
    return template.format(k=k, size=abs(i), way=way, way_cn=way_cn, **values)


def content_of(case: dict[str, Any]) -> bytes:
    """Return the file of a case."""
    lines = [case["head"]] if "head" in case else []
    text = "\n".join([*lines, *(row_of(case, k) for k in range(ROWS)), case.get("foot", "")])
    return text.replace("\n", case.get("ends", "\n")).encode(case.get("encoding", "utf-8"))


def options_of(case: dict[str, Any]) -> dict[str, Any]:
    """Return what the user of a case states."""
    names = {"columns": "columns", "sign": "sign", "temperature": "temperature_c",
             "temperature_source": "temperature_source"}  # fmt: skip
    return {name: case[key] for key, name in names.items() if key in case}
