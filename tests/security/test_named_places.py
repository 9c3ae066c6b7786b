"""No command writes, moves or sends anything to a place that the user did not name."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from live import leaf_model_path
from synthetic import synthetic_log

WATCH = """
import json, os, sys
from cangauge.__main__ import main
SEEN, WRITES = [], os.O_WRONLY | os.O_RDWR | os.O_CREAT
def note(event, args):
    if event == "open" and not isinstance(args[0], int) and args[2] & WRITES:
        SEEN.append(os.fsdecode(args[0]))
    elif event in ("os.rename", "os.mkdir", "os.symlink", "os.link", "os.truncate"):
        SEEN.extend(str(each) for each in args if isinstance(each, str | os.PathLike))
    elif event in ("socket.connect", "socket.sendto", "socket.sendmsg", "subprocess.Popen"):
        SEEN.append(f"{event} {args[1]}")
sys.addaudithook(note)
ended = {}
for name, arguments in json.loads(sys.argv[1]).items():
    SEEN.clear()
    sys.argv = ["cangauge", *arguments]
    try:
        main()
    except SystemExit as end:
        ended[name] = [end.code or 0, list(SEEN)]
with open(os.environ["ENDED"], "w") as out:
    json.dump(ended, out)
"""
COMMANDS = {
    "inspect": ["inspect", "trip.csv"],
    "fit": ["fit", "trip.csv", "--capacity-ah", "60", "-o", "named/model.json"],
    "estimate": ["estimate", "trip.csv", "-m", str(leaf_model_path()), "-o", "named/soc.csv"],
    "gap": ["gap", "trip.csv", "-m", str(leaf_model_path())],
    "judge": ["judge", "trip.csv", "-m", str(leaf_model_path())],
    "run": ["run", "-m", str(leaf_model_path()), "--interface", "virtual", "--channel", "x",
            "--config", "named/run.toml"],
}  # fmt: skip


def test_a_command_writes_and_sends_only_where_it_is_told_to(tmp_path: Path) -> None:
    """All commands run in one process, whose audit hook cannot be removed."""
    home, named = tmp_path / "home", tmp_path / "named"
    home.mkdir()
    named.mkdir()
    log = synthetic_log(hours=0.5, rate_hz=1.0, start_pct=80.0, end_pct=60.0)
    assert log.soc_pct is not None
    columns = (log.time_s, log.current_a, log.voltage_v, log.temperature_c, log.soc_pct)
    rows = [",".join(f"{value:.4f}" for value in row) for row in zip(*columns, strict=True)]
    head = "time_s,current_a,voltage_v,temperature_c,soc_pct"
    (tmp_path / "trip.csv").write_text("\n".join([head, *rows, ""]))
    (named / "run.toml").write_text('duration_s = 0.5\nstatus_socket = "off"\n')
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    environment = {
        "PATH": os.environ["PATH"], "HOME": str(home), "ENDED": str(tmp_path / "ended"),
        "TMPDIR": str(home), "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    process = subprocess.run(
        [sys.executable, "-c", WATCH, json.dumps(COMMANDS)],
        cwd=tmp_path, env=environment, capture_output=True, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    ended = json.loads((tmp_path / "ended").read_text())
    assert list(ended) == list(COMMANDS)
    allowed = {named, Path(os.devnull), Path("/dev/fd")}  # of an open file
    for name, (code, paths) in ended.items():
        assert code == 0, (name, process.stderr)
        seen = [Path(tmp_path, each) for each in paths]
        assert [each for each in seen if allowed.isdisjoint((each, *each.parents))] == [], name
    assert list(home.rglob("*")) == []
    for path, content in before.items():
        assert path.read_bytes() == content
