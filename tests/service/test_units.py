"""The files for operators: systemd's units, the example configuration, damaged files."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from cangauge.extras.live.addresses import http_address
from cangauge.service.config import load_config

NAME = "cangauge@.service"


@pytest.fixture
def units(project: Path, tmp_path: Path) -> Path:
    """The units as an operator installs them, with a command that is there."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    source = project / "contrib" / "systemd"
    text = (source / NAME).read_text().replace("/usr/local/bin/cangauge", "/bin/true")
    (tmp_path / NAME).write_text(text)
    (tmp_path / "cangauge@can0.service").write_text(text)
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
    verified = analyze(units, "verify", str(units / "cangauge@can0.service"))
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
