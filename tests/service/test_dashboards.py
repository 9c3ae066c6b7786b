"""Dashboards and alerts against a real Prometheus that scrapes a running service."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from live import waits
from running import RunningService, free_port

GRAFANA = Path(__file__).resolve().parents[2] / "contrib" / "grafana"
BOARDS = sorted((GRAFANA / "dashboards").glob("*.json"))
NOT_ON_THIS_BUS = {"cangauge_bus_queue_drops_total"}
"""A count of SocketCAN only."""

needs_prometheus = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None,
    reason="prometheus is not installed (apt-get install prometheus)",
)


def board(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def expressions() -> list[tuple[str, str]]:
    """Return title and expression of each query of both boards."""
    return [
        (panel["title"], target["expr"])
        for path in BOARDS
        for panel in board(path)["panels"]
        for target in panel["targets"]
    ]


class Prometheus:
    """A Prometheus that scrapes a service each half second."""

    def __init__(self, folder: Path, target_port: int) -> None:
        self._url = f"http://127.0.0.1:{free_port()}"
        config = (GRAFANA / "prometheus.yml").read_text(encoding="utf-8")
        config = config.replace("127.0.0.1:9464", f"127.0.0.1:{target_port}")
        (folder / "prometheus.yml").write_text(config.replace(": 5s", ": 500ms"))
        shutil.copy(GRAFANA / "alerts.yml", folder)
        self._process = subprocess.Popen(
            ["prometheus", f"--config.file={folder / 'prometheus.yml'}",
             f"--storage.tsdb.path={folder / 'tsdb'}",
             f"--web.listen-address={self._url.removeprefix('http://')}"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def query(self, expression: str) -> list[dict[str, Any]]:
        """Return the result of an expression now; [] while Prometheus is not up."""
        where = f"{self._url}/api/v1/query?{urllib.parse.urlencode({'query': expression})}"
        try:
            with urllib.request.urlopen(where, timeout=5.0) as answer:  # noqa: S310
                found: list[dict[str, Any]] = json.load(answer)["data"]["result"]
        except urllib.error.HTTPError as error:
            if error.code == 503:  # it is starting
                return []
            raise AssertionError(f"{expression}: {error.read().decode()}") from error
        except urllib.error.URLError:
            return []
        return found

    def end(self) -> None:
        self._process.kill()
        self._process.wait(5.0)


@pytest.fixture(scope="module")
def scraped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RunningService, Any]]:
    folder = tmp_path_factory.mktemp("scraped")
    with RunningService(folder, 'record = "drive.log"\n', with_cells=True) as running:
        prometheus = Prometheus(folder, running.port)
        try:
            assert waits(
                lambda: bool(prometheus.query("rate(cangauge_latency_seconds_count[10s]) > 0")),
                20.0,
            )
            running.silent.set()  # so that there is a reason to show
            assert waits(
                lambda: bool(prometheus.query('cangauge_reason{reason="input_stale"} > 0')), 10.0
            )
            yield running, prometheus
        finally:
            prometheus.end()


@needs_prometheus
def test_each_query_of_the_boards_returns_data(scraped: tuple[RunningService, Any]) -> None:
    running, prometheus = scraped
    values = {
        "$job": "cangauge",
        "$instance": f"127.0.0.1:{running.port}",
        "$__rate_interval": "20s",
    }
    assert len(expressions()) > 50
    for title, written in expressions():
        expression = written
        for name, value in values.items():
            expression = expression.replace(name, value)
        result = prometheus.query(expression)
        is_elsewhere = bool(set(re.findall(r"\w+", expression)) & NOT_ON_THIS_BUS)
        assert bool(result) is not is_elsewhere, (title, expression)
        for each in result:
            assert not math.isnan(float(each["value"][1])), (title, expression)


@needs_prometheus
def test_the_values_are_those_of_the_service(scraped: tuple[RunningService, Any]) -> None:
    running, prometheus = scraped
    [soc] = prometheus.query("cangauge_soc_percent")
    assert float(soc["value"][1]) == pytest.approx(running.service.pipeline.published.soc_pct)
    [weakest] = prometheus.query("cangauge_weakest_cell")
    assert float(weakest["value"][1]) == 40
    [status] = [each for name, each in expressions() if name == "Status" and "max without" in each][
        :1
    ]
    expression = status.replace('job="$job", instance="$instance", ', "")
    assert [each["value"][1] for each in prometheus.query(expression)] == ["3"]  # INVALID


@needs_prometheus
def test_alerts_fire_when_they_should(tmp_path: Path) -> None:
    shutil.copy(GRAFANA / "alerts.yml", tmp_path)
    service = 'job="cangauge", instance="a:9464"'
    series = {
        f'cangauge_status{{{service}, status="invalid"}}': "0x6 1x12",
        f"cangauge_sample_age_seconds{{{service}}}": "0x6 5 15 25x12",
        f"cangauge_loop_age_seconds{{{service}}}": "0.1x30",
        f"up{{{service}}}": "1x12 0x12",
    }
    expected = {
        "CangaugeSocInvalid": (50, 130),
        "CangaugeBusSilent": (60, 100),
        "CangaugeGone": (110, 160),
    }
    checks = [{"expr": 'count(ALERTS{alertname="CangaugeLoopStuck"})', "eval_time": "130s"}]
    for name, (quiet_s, firing_s) in expected.items():
        count = f'count(ALERTS{{alertname="{name}", alertstate="firing"}})'
        one = [{"labels": "{}", "value": 1}]
        checks.append({"expr": count, "eval_time": f"{quiet_s}s"})
        checks.append({"expr": count, "eval_time": f"{firing_s}s", "exp_samples": one})
    inputs = [{"series": name, "values": values} for name, values in series.items()]
    test = {"interval": "10s", "input_series": inputs, "promql_expr_test": checks}
    content = {"rule_files": ["alerts.yml"], "evaluation_interval": "10s", "tests": [test]}
    (tmp_path / "test.yml").write_text(json.dumps(content))  # JSON is YAML
    done = subprocess.run(
        ["promtool", "test", "rules", tmp_path / "test.yml"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("path", BOARDS, ids=lambda each: each.stem)
def test_a_board_is_what_grafana_provisions(path: Path) -> None:
    content = board(path)
    assert content["id"] is None  # Grafana gives it, and finds the board by uid
    assert re.fullmatch(r"[\w-]{1,40}", content["uid"])
    ids = [panel["id"] for panel in content["panels"]]
    assert len(set(ids)) == len(ids)
    variables = {each["name"] for each in content["templating"]["list"]} | {"__rate_interval"}
    for panel in content["panels"]:
        assert panel["type"] in {"timeseries", "stat", "state-timeline"}
        letters = [each["refId"] for each in panel["targets"]]
        assert len(set(letters)) == len(letters)
        assert set(re.findall(r"\$\{?(\w+)", json.dumps(panel))) <= variables
