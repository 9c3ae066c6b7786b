"""A car with cell voltages on its bus: DBC, map and frames, for tests."""

from __future__ import annotations

import math
from collections.abc import Sequence

import can

CELLS_ON_BUS = 96


def _dbc() -> str:
    groups = range((CELLS_ON_BUS + 2) // 3)
    cells = "\n".join(
        f" SG_ CELL_{3 * group + place + 1}_V m{group} : {8 + 16 * place}|16@1+ (0.001,0) [0|65]"
        ' "V" Receiver'
        for group in groups
        for place in range(3)
        if 3 * group + place < 12
    )
    # A second array with all 96 cells, in mV, whose unit the DBC states.
    all_cells = "\n".join(
        f" SG_ VC{3 * group + place + 1:02d} m{group} : {8 + 16 * place}|16@1+ (1,0) [0|65535]"
        ' "mV" Receiver'
        for group in groups
        for place in range(3)
    )
    codes = "".join(f'VAL_ 1088 CELL_{n}_V 65535 "not available" ;\n' for n in range(1, 13))
    return f"""VERSION ""

NS_ :

BS_:

BU_: Car Receiver

BO_ 1088 CELL_ARRAY: 8 Car
 SG_ cell_group M : 0|8@1+ (1,0) [0|255] "" Receiver
{cells}

BO_ 1089 CELL_GROUPS: 8 Car
 SG_ group_number : 0|8@1+ (1,0) [0|255] "" Receiver
 SG_ cell_a : 8|16@1+ (0.001,0) [0|65] "V" Receiver
 SG_ cell_b : 24|16@1+ (0.001,0) [0|65] "V" Receiver
 SG_ cell_c : 40|16@1+ (0.001,0) [0|65] "V" Receiver

BO_ 1090 ALL_CELLS: 8 Car
 SG_ all_group M : 0|8@1+ (1,0) [0|255] "" Receiver
{all_cells}

{codes}"""


CELLS_DBC = _dbc()

CAR = """
name = "car with cells"
dbc = "cells.dbc"

[current]
message = "PACK_CURRENT"
signal = "current_a"

[voltage]
message = "PACK_VOLTAGE"
signal = "voltage_v"

[temperature]
message = "PACK_TEMPERATURE"
signal = "temperature_c"

[messages.PACK_CURRENT]
protection = "generic"
[messages.PACK_VOLTAGE]
protection = "generic"
[messages.PACK_TEMPERATURE]
protection = "generic"

"""

ALL_CELLS = f'[cells]\nsignal = "VC{{n:02d}}"\ncount = {CELLS_ON_BUS}\n'


def _frame(frame_id: int, number: int, volts: Sequence[float], time_s: float) -> can.Message:
    raw = [0xFFFF if math.isnan(each) else round(1000.0 * each) for each in volts]
    data = bytes([number]) + b"".join(each.to_bytes(2, "little") for each in raw)
    return can.Message(
        timestamp=time_s, arbitration_id=frame_id, is_extended_id=False, data=data.ljust(8, b"\0")
    )


def _frames(
    frame_id: int, cells_v: Sequence[float], time_s: float, first: int = 0
) -> list[can.Message]:
    return [
        _frame(frame_id, first + at // 3, cells_v[at : at + 3], time_s)
        for at in range(0, len(cells_v), 3)
    ]


def cell_frames(cells_v: Sequence[float], time_s: float = 1.0) -> list[can.Message]:
    """Return the frames of up to 12 cells [V] as CELL_ARRAY."""
    return _frames(0x440, cells_v, time_s)


def numbered_frames(
    cells_v: Sequence[float], time_s: float = 1.0, first: int = 0
) -> list[can.Message]:
    """Return the frames of cells [V] as CELL_GROUPS."""
    return _frames(0x441, cells_v, time_s, first)


def all_cell_frames(cells_v: Sequence[float], time_s: float = 1.0) -> list[can.Message]:
    """Return the frames of all cells [V] as ALL_CELLS."""
    return _frames(0x442, cells_v, time_s)
