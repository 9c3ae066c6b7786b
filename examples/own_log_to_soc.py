"""From tables of your own to a state of charge.

    python examples/own_log_to_soc.py

The tables are simulated here; yours come from `pandas.read_csv`, a database or a logger.
"""

from __future__ import annotations

import pyarrow as pa

import cangauge


def my_table(drive: int) -> pa.Table:
    """Stand in for your own data: one drive from full to empty (pandas and polars work too)."""
    return cangauge.simulate(seed=7, drive=drive, discharge=True).log.to_arrow()


def main() -> None:
    """Identify a model on two drives, estimate a third, and print how good it was."""
    drives = [cangauge.Log.from_dataframe(my_table(number)) for number in (1, 2, 3)]
    identified = cangauge.fit(drives[:2])
    identified.model.save("pack.json")
    print(
        f"voltage error {identified.voltage_mae_pct:.2f} %, {identified.model.capacity_ah:.1f} Ah"
    )

    table = cangauge.estimate(drives[2], identified.model, initial_soc_pct="auto")
    print(f"SoC at the end: {table.soc_pct[-1]:.1f} ± {table.soc_std_pct[-1]:.1f} %")
    assert table.scores is not None
    print(f"mean error of the SoC: {table.scores.soc_mae_pct:.2f} %")


if __name__ == "__main__":
    main()
