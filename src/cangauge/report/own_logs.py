"""The page of `cangauge gap-check` on one's own logs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cangauge._formatting import number
from cangauge.report.charts import BLUE, GREY, bars
from cangauge.report.page import Figure, Page, Section, Table, joined, render
from cangauge.validation.own_logs import summary, table


def own_logs_report(result: Mapping[str, Any]) -> str:
    """Return the result of `validation.own_logs.summarize` as one self-contained page."""
    head, rows = table(result)
    head[0] = head[0].removeprefix("<")
    largest = [(item["effect"], item["sizes"][-1]) for item in result["effects"]]
    shares = [
        (name, 100.0 * of["probability"], BLUE if 2 * of["named"] > of["of"] else GREY)
        for name, of in largest
    ]
    healthy = [
        [item["log"], item["verdict"], number(item["probability_none"], 2),
         number(item["floor_v"], 2)]
        for item in result["healthy"]
    ]  # fmt: skip
    names = [item["log"] for item in result["healthy"]]
    return render(
        Page(
            title="What this diagnosis would find on this pack",
            lead=summary(result),
            subtitle=f"Every effect injected into {joined(names)}, each diagnosed with the other"
            " logs as references.",
            tiles=[],
            sections=[
                Section(
                    "Effects",
                    [
                        Table(
                            head,
                            rows,
                            note="Size, mean probability of the true effect, and the logs on which"
                            " it is named. Its limit: physically no larger one is possible.",
                        ),
                        Figure(
                            "Probability of the true effect at the largest size",
                            bars("probability", "%", shares, decimals=0),
                            "Blue: named on more than half of the logs.",
                        ),
                    ],
                ),
                Section(
                    "Logs as recorded",
                    [Table(["log", "verdict", "P(none)", "floor [V]"], healthy)],
                ),
            ],
        )
    )
