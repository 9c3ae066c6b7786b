"""A model that fitted yesterday does not fit today: find out why, and go on with a better one.

python examples/read_a_diagnosis.py
"""

from __future__ import annotations

import cangauge


def drive(number: int, effects: str = "") -> cangauge.Log:
    """Return one of the pack's drives, with a fault or without."""
    return cangauge.simulate(effects or (), seed=5, drive=number, plant="equation").log


def main() -> None:
    """Diagnose a drive whose current and voltage are stamped apart; save the extended model."""
    full = cangauge.simulate(seed=5, drive=20, plant="equation", discharge=True).log
    references = [drive(number) for number in (1, 2, 3)]
    model = cangauge.fit([full]).model

    found = cangauge.diagnose([drive(9, "time_skew:skew_s=0.8")], model, references)
    print(found.summary)
    for name, probability in sorted(
        found.verdict.probabilities.items(), key=lambda item: item[1], reverse=True
    )[:3]:
        print(f"  {name}: {probability:.2f}")
    for caveat in found.caveats:
        print("caveat:", caveat)
    found.extended_model.save("extended.json")  # `cangauge estimate` and `cangauge run` take it


if __name__ == "__main__":
    main()
