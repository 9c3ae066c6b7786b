"""What the commands on a bus have in common: options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cangauge.bus.presets import PRESETS
from cangauge.errors import InputError

InterfaceOption = Annotated[
    str | None,
    typer.Option(
        metavar="I",
        help="python-can interface: socketcan, udp_multicast, pcan, slcan, … Default: socketcan"
        " where there is a vcan0, else udp_multicast, whose packets stay on this machine.",
    ),
]
ChannelOption = Annotated[
    str | None,
    typer.Option(metavar="C", help="Channel, e.g. can0. Default: vcan0, or 239.74.163.2."),
]
BusOptionOption = Annotated[
    list[str] | None,
    typer.Option(
        "--bus-option", metavar="K=V", help="More for the bus's driver, e.g. bitrate=500000."
    ),
]
BusVehicleOption = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        metavar="PRESET",
        help=f"Whose frames: {', '.join(PRESETS)}. Default: generic, without --dbc and --map.",
    ),
]
BusDbcOption = Annotated[
    Path | None, typer.Option("--dbc", metavar="FILE", help="Another car's DBC; needs --map.")
]
BusMapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="TOML file: which signals are current, voltage and temperature, with sign and scale.",
    ),
]
BusTemperatureOption = Annotated[
    float | None,
    typer.Option("--temperature", metavar="C", help="Constant temperature [°C], not the bus's."),
]
EstimateIdOption = Annotated[
    str | None, typer.Option(metavar="ID", help="Id of SOC_ESTIMATE. Default: 0x5A0.")
]
DetailIdOption = Annotated[
    str | None, typer.Option(metavar="ID", help="Id of SOC_DETAIL. Default: 0x5A1.")
]
ClockIdOption = Annotated[
    str | None, typer.Option(metavar="ID", help="Id of REPLAY_CLOCK. Default: 0x5AF.")
]


def frame_ids(
    soc_estimate: str | None, soc_detail: str | None, replay_clock: str | None
) -> dict[str, int]:
    """Return those of the ids that were given, by their key; "0x…" is hexadecimal.

    Raises
    ------
    InputError
        If one is no number.
    """
    given = {
        "soc_estimate": soc_estimate,
        "soc_detail": soc_detail,
        "replay_clock": replay_clock,
    }
    ids = {}
    for key, text in given.items():
        if text is None:
            continue
        try:
            ids[key] = int(text, 0)
        except ValueError as error:
            raise InputError(
                "no CAN id",
                field=f"--{key.replace('_', '-')}-id",
                value=text,
                cure="write it as 0x5A0",
            ) from error
    return ids
