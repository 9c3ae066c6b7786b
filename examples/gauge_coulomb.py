r"""A gauge that only counts, as small as one can be; for `cangauge judge --suite`.

cangauge judge --suite -- python examples/gauge_coulomb.py {interface} {channel} {port} \
        {capacity_ah} {soc}
"""

import sys

import can
import cantools

from cangauge._resources import shared_file

interface, channel, port = sys.argv[1:4]
capacity_ah, soc_pct = map(float, sys.argv[4:6])
pack = cantools.database.load_file(shared_file("dbc", "generic_pack.dbc"))
ours = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
answer = ours.get_message_by_name("SOC_ESTIMATE")
clock = ours.get_message_by_name("REPLAY_CLOCK")


def publish() -> None:
    """Send the SoC; σ is not known: its largest code."""
    values = {signal.name: 0 for signal in answer.signals}
    data = bytearray(answer.encode({**values, "soc_pct": min(max(soc_pct, 0.0), 100.0)}))
    word = int.from_bytes(data, "little") | 0x7FF << 33  # "not available"
    frame_data = word.to_bytes(8, "little")
    bus.send(can.Message(arbitration_id=answer.frame_id, data=frame_data, is_extended_id=False))


with can.Bus(interface=interface, channel=channel, port=int(port)) as bus:
    publish()
    now_s = before_s = current_a = None
    for frame in bus:
        if frame.arbitration_id == clock.frame_id:
            now_s = clock.decode(frame.data)["log_time_us"] / 1e6
        elif frame.arbitration_id == 0x400 and now_s is not None:
            if current_a is not None:
                soc_pct -= 100.0 * current_a * (now_s - before_s) / 3600.0 / capacity_ah
            current_a = pack.decode_message(0x400, frame.data)["current_a"]
            before_s = now_s
        elif frame.arbitration_id == 0x401:
            publish()
