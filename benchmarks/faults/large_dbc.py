"""A lawful DBC of any size: the generic pack's, with messages of others."""

from __future__ import annotations

from pathlib import Path

from cangauge._resources import shared_file

MAP = """
dbc = ["large.dbc"]
name = "car of a large DBC"
[current]
message = "PACK_CURRENT"
signal = "current_a"
[voltage]
message = "PACK_VOLTAGE"
signal = "voltage_v"
[temperature]
message = "PACK_TEMPERATURE"
signal = "temperature_c"
"""
_SIGNAL = ' SG_ Signal_{0}_{1} : {2}|8@1+ (0.5,-40) [0|100] "unit" Vector__XXX\n'


def write_large_dbc(folder: Path, megabytes: float) -> None:
    """Write large.dbc and map.toml into a folder."""
    text = shared_file("dbc", "generic_pack.dbc").read_text() + "\n"
    parts, size, number = [text], len(text), 0
    while size < megabytes * 1e6:
        message = f"BO_ {0x9800_0000 + number} Other_{number}: 8 Vector__XXX\n" + "".join(
            _SIGNAL.format(number, place, 8 * place) for place in range(8)
        )
        parts.append(message + "\n")
        size += len(message) + 1
        number += 1
    (folder / "large.dbc").write_text("".join(parts))
    (folder / "map.toml").write_text(MAP)
