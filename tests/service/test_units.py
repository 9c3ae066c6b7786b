"""The files for operators: systemd's units, the example configuration, damaged files."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from cangauge.extras.live.addresses import http_address
from cangauge.service.config import load_config
from cangauge.service.setup import address_of
from cangauge.service.status_client import StatusSocket, find_socket, socket_path

NAME, LIVE = "cangauge@.service", "cangauge-live@.service"


@pytest.fixture
def units(project: Path, tmp_path: Path) -> Path:
    """The units as an operator installs them, with a command that is there."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    source = project / "contrib" / "systemd"
    for name in (NAME, LIVE):
        text = (source / name).read_text().replace("/usr/local/bin/cangauge", "/bin/true")
        (tmp_path / name).write_text(text)
        (tmp_path / name.replace("@", "@can0")).write_text(text)
    (tmp_path / f"{NAME}.d").mkdir()
    shutil.copy(source / "hardening.conf", tmp_path / f"{NAME}.d")
    return tmp_path


def analyze(units: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", *arguments],
        env={"SYSTEMD_UNIT_PATH": f"{units}:", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )


def test_the_units_are_what_systemd_reads(units: Path) -> None:
    for name in ("cangauge@can0.service", "cangauge-live@can0.service"):
        verified = analyze(units, "verify", str(units / name))
        assert verified.returncode == 0, verified.stderr
        # It only warns of keys that it does not know.
        assert "cangauge" not in verified.stderr
    broken = units / f"{NAME}.d" / "broken.conf"
    broken.write_text("[Service]\nProtectSystm=strict\n")
    assert "ProtectSystm" in analyze(units, "verify", str(units / "cangauge@can0.service")).stderr


def test_the_hardened_service_is_exposed_little(units: Path) -> None:
    rated = analyze(units, "security", "--offline=true", "cangauge@can0.service")
    if "offline" in rated.stderr:
        pytest.skip("this systemd cannot rate units offline")
    found = re.search(r"exposure level for .*: ([\d.]+)", rated.stdout)
    assert found is not None, rated.stdout + rated.stderr
    assert float(found[1]) <= 2.0


def test_the_unit_names_options_that_there_are(project: Path) -> None:
    text = (project / "contrib" / "systemd" / NAME).read_text()
    command = re.search(r"^ExecStart=\S+ run (.*)$", text, re.MULTILINE)
    assert command is not None
    from cangauge.cli.app import load_command  # noqa: PLC0415

    known = {option for parameter in load_command("run").params for option in parameter.opts}
    assert set(re.findall(r"--[\w-]+", command[1])) <= known


def test_the_example_configuration_is_one(project: Path) -> None:
    config = load_config(project / "contrib" / "systemd" / "example.toml")
    assert config.record == "/var/lib/cangauge/can0/drive.log.gz"
    assert (config.record_part_mb, config.record_keep_mb) == (64, 2000)
    assert http_address(str(config.http), None, {}).host == "127.0.0.1"


def test_the_status_socket_of_the_unit_is_found(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (project / "contrib" / "systemd" / NAME).read_text().replace("%i", "can0")
    folder = re.findall(r"^RuntimeDirectory=(.*)$", text, re.MULTILINE)
    stated = re.findall(r"/run/(\S*\.sock)", text)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / folder[0]))
    config = load_config(project / "contrib" / "systemd" / "example.toml")
    made = socket_path(str(address_of(config)))
    assert [str(made.relative_to(tmp_path))] == stated
    # Another program, such as `cangauge status` or the live unit, has no such variable.
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    monkeypatch.setattr("cangauge.service.status_client.SYSTEM_FOLDER", tmp_path / "cangauge")
    with contextlib.closing(StatusSocket(made, dict)):
        assert find_socket(made.name) == made
