"""The engine under test: evidence and features of a case. The one place that knows its names."""
from __future__ import annotations
import sys
from dataclasses import dataclass
import numpy as np
sys.path.insert(0, "/work/shared/prototypes")
import diagnosis_engine as de
from cangauge.logs.log import Log
GROUPS = {g.replace(" ", "_"): v for g, v in de.GROUPS.items()}

def _smooth(c, n=120):
    if np.unique(np.round(c * 10)).size > 0.05 * len(c) and len(c) > 200: return c
    k = np.ones(n) / n
    p = np.concatenate([np.full(n, c[0]), c, np.full(n, c[-1])])
    return np.convolve(p, k, "same")[n:-n]

def trace(log: Log):
    t = np.arange(int(log.duration_s) + 1) + log.time_s[0]
    f = lambda x: np.interp(t, log.time_s, x)
    k = np.flatnonzero(np.isfinite(log.soc_pct))[0]
    return de.Log(f(log.current_a), f(log.voltage_v), _smooth(f(log.temperature_c)), float(log.soc_pct[k]))

def thin(log):
    from benchmarks.weights.packs import thinned
    return thinned(log, 1.0)

def learn(refs, capacity_ah):
    return de.learn([trace(thin(x)) for x in refs], capacity_ah), [trace(thin(x)) for x in refs]

def floor_v(refs, capacity_ah):
    known, _ = learn(refs, capacity_ah)
    return float(np.sqrt(np.mean([x["gap_v2"] for x in known.left_out])))

@dataclass
class Features:
    names: tuple
    inner: np.ndarray
    outer: np.ndarray
    sizes: np.ndarray

def evidence(learned, logs, without=()):
    known, refs = learned
    tr = [trace(x) for x in logs]
    found = de.analyse(known, [de.columns(known.pack, x, known.effects, refs) for x in tr])
    lo = min(x.temperature_c.min() for x in refs); hi = max(x.temperature_c.max() for x in refs)
    colder = max(0, lo - 3 - min(x.temperature_c.min() for x in tr), max(x.temperature_c.max() for x in tr) - hi - 3)
    return known, found, colder

def features(known, found, colder, without=()):
    eff = {k: z for k, z in found["effects"].items() if k not in without}
    left = known.left_out
    v = float(np.mean([x["gap_v2"] for x in left]))
    nats = {k: max(z["nats"], 0) for k, z in eff.items()}
    volts = {k: np.log((v + found["gap_v2"]) / (v + z["left_v2"])) for k, z in eff.items()}
    names = tuple(eff)
    inner = np.array([[np.log1p(nats[k]), volts[k], min(colder / 3, 1) if k == "resistance_temperature" else 0.0] for k in names])
    best = max(eff, key=lambda k: np.log1p(nats[k]) + volts[k])
    most = np.log1p(max(nats.values()))
    healthy = [max(z["nats"] / known.excess[k] for k, z in x["effects"].items() if k not in without) for x in left]
    outer = np.array([np.log(eff[best]["left_v2"] / v + 0.1), most, most - np.log1p(np.mean(np.maximum(healthy, 0))), 1.0])
    return Features(names, inner, outer, np.array([eff[k]["size"] for k in names]))
