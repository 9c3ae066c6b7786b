import pickle, sys, time, json
from pathlib import Path
from benchmarks.weights import cases, engine
part = sys.argv[1]; folder = Path(sys.argv[2]); data = Path("../shared/data")
items = cases.plan(part, data, {"weights": 1, "frozen": 2}[part])
only = sys.argv[3:] 
t0 = time.time()
n = 0
for number, item in enumerate(items):
    if only and item["pack"] not in only: continue
    t = time.time()
    try:
        split = list(cases.draw_one(items, number, part, data, folder))
    except Exception as e:
        import traceback; traceback.print_exc(); print(number, item["pack"], "FAILED", e, flush=True); continue
    n += len(split[0].cases)
    print(number, item["pack"], len(item["cases"]), len(split[0].cases), round(split[0].floor_v, 3), round(time.time() - t, 1), round(time.time() - t0), flush=True)
