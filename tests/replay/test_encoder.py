"""Samples → frames, and back."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample
from live import quantized

VEHICLES = {
    "generic": Vehicle.load("generic"),
    "leaf_ze0": Vehicle.load("leaf_ze0"),
    "leaf_ze1": Vehicle.load("leaf_ze1", temperature_c=18.0),
}


def make_log(rows: list[tuple[float, float, float, float, float]]) -> Log:
    current, voltage, temperature, soc, step = np.array(rows).T
    return Log(np.cumsum(step), current, voltage, temperature, soc)


logs = st.lists(
    st.tuples(
        st.floats(-490.0, 490.0),
        st.floats(0.0, 510.0),
        st.floats(-39.0, 80.0),
        st.one_of(st.floats(0.0, 100.0), st.just(math.nan)),
        st.floats(0.03, 30.0),
    ),
    min_size=1,
    max_size=30,
).map(make_log)


def through_frames(vehicle: Vehicle, log: Log) -> tuple[list[Sample], list[float]]:
    encoder, assembler = FrameEncoder(vehicle), SampleDecoder(vehicle)
    samples, references = [], []
    soc = log.soc_pct if log.soc_pct is not None else np.full(len(log), math.nan)
    for row, reference in zip(rows_of(log), soc.tolist(), strict=True):
        for message in encoder.encode(row, reference):
            made = assembler.handle(message)
            if made is not None:
                samples.append(made)
                references.append(assembler.reference_soc_pct)
    counters = assembler.statistics
    assert counters.crc_errors == counters.counter_repeats == counters.frames_lost == 0
    return samples, references


def rows_of(log: Log) -> list[Sample]:
    columns = (log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    return [Sample(*row) for row in zip(*(each.tolist() for each in columns), strict=True)]


@pytest.mark.parametrize("name", list(VEHICLES))
@given(log=logs)
def test_the_decoder_gives_the_quantized_log_bit_for_bit(name: str, log: Log) -> None:
    encoder = FrameEncoder(VEHICLES[name])
    encoder.check_range(log)
    # Time goes through REPLAY_CLOCK, which is not part of these frames.
    bound, read = encoder.quantization(), quantized(encoder.vehicle, log)
    samples, references = through_frames(VEHICLES[name], log)
    assert [each[1:] for each in samples] == [each[1:] for each in rows_of(read)]
    assert read.soc_pct is not None
    for got, wanted in zip(references, read.soc_pct.tolist(), strict=True):
        assert math.isnan(wanted) or got == wanted
    for field in bound:
        error = np.abs(getattr(read, field) - getattr(log, field))
        assert np.nanmax(error, initial=0.0) <= bound[field] * (1 + 1e-6)


def test_the_bounds_are_those_of_the_dbc() -> None:
    names = ("time_s", "current_a", "voltage_v", "soc_pct", "temperature_c")
    generic, leaf = (
        FrameEncoder(VEHICLES[name]).quantization() for name in ("generic", "leaf_ze1")
    )
    assert generic == dict(zip(names, (0.5e-6, 0.00005, 0.00005, 0.0025, 0.005), strict=True))
    assert leaf == dict(zip(names[:4], (0.5e-6, 0.25, 0.25, 0.05), strict=True))


def test_slow_frames_come_first_and_only_when_due() -> None:
    encoder = FrameEncoder(VEHICLES["generic"])

    def ids(time_s: float, temperature_c: float = 20.0) -> list[int]:
        sample = Sample(time_s, 1.0, 400.0, temperature_c)
        return [message.arbitration_id for message in encoder.encode(sample, 50.0)]

    assert ids(0.0) == [0x402, 0x403, 0x400, 0x401]
    assert ids(0.5) == [0x400, 0x401]
    assert ids(0.9, 20.004) == [0x400, 0x401]  # the same, as a frame carries it
    assert ids(0.95, 20.02) == [0x402, 0x400, 0x401]
    assert ids(1.0, 20.02) == [0x403, 0x400, 0x401]
    assert ids(2.5, 20.02) == [0x402, 0x403, 0x400, 0x401]
    assert ids(0.0, 20.02) == [0x402, 0x403, 0x400, 0x401]  # a log that starts again


def test_counters_run_per_message_with_sample_times() -> None:
    encoder = FrameEncoder(VEHICLES["generic"])
    counters: dict[int, list[int]] = {}
    for n in range(40):
        for message in encoder.encode(Sample(0.1 * n, 1.0, 400.0, 20.0), 50.0):
            counters.setdefault(message.arbitration_id, []).append(message.data[-2] >> 4)
            assert message.timestamp == 0.1 * n
            assert not message.is_extended_id
    assert counters[0x400] == [n % 16 for n in range(40)]
    assert counters[0x402] == [0, 1, 2, 3]


def test_missing_values_get_their_code() -> None:
    generic = FrameEncoder(VEHICLES["generic"])
    sent = generic.encode(Sample(0.0, 1.0, math.nan, math.nan), math.nan)
    assert [message.arbitration_id for message in sent] == [0x400]
    leaf = VEHICLES["leaf_ze0"]
    assembler = SampleDecoder(leaf)
    (message,) = FrameEncoder(leaf).encode(Sample(0.0, 1.0, math.nan, math.nan))
    made = assembler.handle(message)
    assert made is not None
    assert made.current_a == 1.0
    assert math.isnan(made.voltage_v)
    assert assembler.statistics.not_available == 1


@pytest.mark.parametrize(
    ("field", "value", "signal"),
    [
        ("current_a", 600.0, "current_a of BATTERY_1DB"),
        ("current_a", -511.5, "current_a of BATTERY_1DB"),
        ("voltage_v", 600.0, "voltage_v of BATTERY_1DB"),
        ("temperature_c", -60.0, "temperature_average_c of BATTERY_5C0"),
        ("soc_pct", 103.0, "soc_pct of BATTERY_55B"),
    ],
)
def test_a_log_that_does_not_fit_is_refused_before_sending(
    field: str, value: float, signal: str
) -> None:
    rows = {"current_a": 1.0, "voltage_v": 380.0, "temperature_c": 20.0, "soc_pct": 50.0}
    columns = {name: np.full(5, each) for name, each in rows.items()}
    columns[field][3] = value
    log = Log(np.arange(5.0), **columns, source="big.csv")
    with pytest.raises(InputError, match=signal) as caught:
        FrameEncoder(VEHICLES["leaf_ze0"]).check_range(log)
    error = caught.value
    assert (error.source, error.field, error.value) == ("big.csv", field, value)
    assert "row is 4" in error.problem
    FrameEncoder(VEHICLES["generic"]).check_range(log)


@given(value=st.floats(-700.0, 700.0) | st.sampled_from([-0.2, -0.3, 511.2]))
def test_the_check_accepts_exactly_what_can_be_sent(value: float) -> None:
    log, encoder = Log([0.0], [1.0], [value], [20.0]), FrameEncoder(VEHICLES["leaf_ze0"])
    try:
        encoder.check_range(log)
    except InputError:
        with pytest.raises(InputError, match="voltage_v") as caught:
            encoder.encode(rows_of(log)[0])
        assert caught.value.value == value
    else:
        assert encoder.encode(rows_of(log)[0])


def test_a_value_that_rounds_out_of_its_range_is_refused_before_sending() -> None:
    """Half a step beyond the last code, rounding to even may stay or go on to the next one."""
    vehicle, outcomes = VEHICLES["generic"], set()
    for column, signal in (("current_a", vehicle.current), ("voltage_v", vehicle.voltage)):
        codec = signal.codec
        for end, beyond in zip(codec.range, (-codec.half_step, codec.half_step), strict=True):
            row = {"current_a": [1.0], "voltage_v": [380.0], column: [end + beyond]}
            log, encoder = Log([0.0], temperature_c=[20.0], **row), FrameEncoder(vehicle)
            try:
                encoder.encode(rows_of(log)[0])
            except InputError:
                outcomes.add("refused")
                with pytest.raises(InputError, match=codec.name):
                    encoder.check_range(log)
            else:
                outcomes.add("sent")
                encoder.check_range(log)
    assert outcomes == {"refused", "sent"}


def test_multiplexed_current_cannot_be_replayed(tmp_path: Path) -> None:
    (tmp_path / "x.dbc").write_text(
        "BO_ 256 M: 8 X\n"
        ' SG_ which M : 0|8@1+ (1,0) [0|0] "" X\n'
        ' SG_ i m0 : 8|16@1- (0.1,0) [0|0] "A" X\n'
        ' SG_ u m1 : 8|16@1+ (0.1,0) [0|0] "V" X\n'
    )
    (tmp_path / "x.toml").write_text(
        'dbc = "x.dbc"\ncurrent.signal = "i"\nvoltage.signal = "u"\ntemperature.fixed_c = 20\n'
    )
    vehicle = Vehicle.load(map=tmp_path / "x.toml")
    with pytest.raises(InputError, match="multiplexed"):
        FrameEncoder(vehicle)
