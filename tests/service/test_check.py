"""`cangauge check` refuses what `run` refuses, and names the key."""

from __future__ import annotations

from pathlib import Path

import pytest

from live import in_process, leaf_model_path

REFUSED = {
    'dashboard = "0.0.0.0:8642"': "dashboard",
    'dashboard = "99999"': "dashboard",
    'http = "localhost"': "http",
    'http = "9464"\nhttp_token_file = "absent"': "absent",
    '[mqtt]\nbroker = "localhost"\npassword_file = "absent"': "absent",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_an_output_needs_is_read_before_the_bus_is_opened(tmp_path: Path, text: str) -> None:
    """Only what is in use, such as a port, is found later."""
    path = tmp_path / "car.toml"
    path.write_text(f'model = "{leaf_model_path()}"\nduration_s = 1\n{text}\n')
    checked, ran = in_process("check", path), in_process("run", "--config", path)
    assert (checked.code, ran.code) == (2, 2)
    assert checked.err == ran.err
    assert REFUSED[text] in checked.err


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('vehicle = "leaf_aze0"\nmap = "car.toml"', "vehicle"),
        ("[ids]\nsoc_detail = 0x400", "ids.soc_detail"),
        ('dashboard = "99999"', "dashboard"),
    ],
)
def test_an_error_names_file_and_key(tmp_path: Path, text: str, key: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(f'model = "{leaf_model_path()}"\n{text}\n')
    assert in_process("check", path).err.startswith(f"error: {path}: {key}: ")
