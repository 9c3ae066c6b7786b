"""What decides between signals: physics beside names, the stated voltage; what decides nothing."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.captures import open_capture
from cangauge.extras.discovery.candidate import Candidate
from cangauge.extras.discovery.search import search
from live import in_process

SECONDS = 120
CODES = 30  # frames at the start that hold the code for no value


def load(seed: int) -> np.ndarray:
    """Return a current in steps of some seconds [A], at 10 Hz."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-80.0, 150.0, SECONDS // 2), 20) + rng.normal(0, 0.3, 10 * SECONDS)


def walk(seed: int) -> np.ndarray:
    """Return what drifts, at 10 Hz."""
    way = np.cumsum(0.05 * np.random.default_rng(seed).normal(size=10 * SECONDS))
    return way - way.mean()


def frames(layout: dict[int, list[np.ndarray]], late_s: float = 0.0) -> Iterator[can.Message]:
    """Yield frames of little-endian words; odd ids come later."""
    for row in range(10 * SECONDS):
        for number, words in layout.items():
            data = b"".join(int(word[row]).to_bytes(2, "little") for word in words)
            stamp = 0.1 * row + late_s * (number % 2)
            yield can.Message(stamp, number, data=data, is_extended_id=False, channel="can0")


def raw(values: np.ndarray, scale: float, offset: float = 0.0) -> np.ndarray:
    return np.rint((values - offset) / scale).astype(int)


def write(folder: Path, messages: Iterator[can.Message], signals: dict[int, list[str]]) -> None:
    with can.CanutilsLogWriter(folder / "d.log") as writer:
        for message in messages:
            writer.on_message_received(message)
    lines = ['VERSION "1"', "NS_ :", "BS_:", "BU_: V"]
    for number, texts in signals.items():
        lines.append(f"BO_ {number} {texts[0]}: {2 * len(texts) - 2} V")
        lines += [
            f" SG_ {text.split()[0]} : {16 * place}|16@1+ {' '.join(text.split()[1:])} V"
            for place, text in enumerate(texts[1:])
        ]
    (folder / "car.dbc").write_text("\n".join([*lines, ""]))


AMPS, VOLTS = '(0.1,-500) [0|0] "A"', '(0.1,0) [0|0] "V"'


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("car")
    amps, still = load(1), np.full(10 * SECONDS, 250)
    pack = [raw(-amps, 0.1, -500.0), raw(370.0 - 0.1 * amps, 0.1), raw(70 + walk(3), 0.1)]
    for word in pack:
        word[:CODES] = 0xFFFF
    others = [raw(load(2) / 10.0, 0.1, -500.0), still, still, still]
    write(folder, frames({0x100: [*pack, still], 0x102: others}), {
        0x100: ["One", f"One_I {AMPS}",
                f"One_U {VOLTS}", 'One_SoC (0.1,0) [0|0] "%"', 'One_Temp (0.1,0) [0|0] "degC"'],
        0x102: ["Two", f"Two_I {AMPS}", 'LvBatt_SoC (0.1,0) [0|0] "%"',
                'CabinTemp (0.1,0) [0|0] "degC"', 'BatCoolantTemp (0.1,0) [0|0] "degC"'],
    })  # fmt: skip
    return folder


def test_a_voltage_that_follows_decides_between_like_names(car: Path, tmp_path: Path) -> None:
    done = in_process("init", car / "d.log", "--dbc", car / "car.dbc", "-o", tmp_path / "out")
    assert done.code == 0, done.err
    text = (tmp_path / "out" / "car.toml").read_text(encoding="utf-8")
    made = tomllib.loads(text)
    roles = ("current", "voltage", "soc", "soc_reference", "temperature")
    named = {role: made[role]["signal"] for role in roles if role in made}
    assert named["current"] == "One_I"
    assert named["temperature"] == "One_Temp"  # of no other part
    assert "LvBatt_SoC" not in named.values()
    assert made["current"]["not_available"] == made["voltage"]["not_available"] == [0xFFFF]
    assert (made["current"]["sign"], "not proven" in text) == (-1, False)
    assert "370" not in done.err
    assert "6553.5" not in done.out


def test_two_packs_are_left_to_the_user_and_pair_beyond_their_periods(tmp_path: Path) -> None:
    amps = load(1)
    layout, signals = {}, {}
    for number, part in ((0x100, "A"), (0x200, "B")):
        layout[number] = [raw(370.0 - 0.1 * amps, 0.1)]
        layout[number + 1] = [raw(amps, 0.1, -500.0)]
        signals[number] = [f"U{part}", f"Pack{part}_U {VOLTS}"]
        signals[number + 1] = [f"I{part}", f"Pack{part}_I {AMPS}"]
    stretched = list(frames(layout, late_s=0.05))
    for each in stretched:
        each.timestamp *= 5.0  # every 0.5 s, voltage 0.25 s before current
    write(tmp_path, iter(stretched), signals)
    call = ("init", tmp_path / "d.log", "--dbc", tmp_path / "car.dbc", "-o", tmp_path / "out")
    done = in_process(*call)
    assert done.code == 1
    assert "record a drive" not in done.err
    done = in_process(*call, "--choose", "current=1", "--choose", "voltage=1")
    assert done.code == 0, done.err
    made = tomllib.loads((tmp_path / "out" / "car.toml").read_text(encoding="utf-8"))
    assert made["pair_within_s"] == pytest.approx(0.6)
    assert (made["current"]["signal"], made["voltage"]["signal"]) == ("PackA_I", "PackA_U")


@pytest.mark.parametrize("seed", [1, 3])
def test_two_limits_that_move_together_are_no_pair(seed: int) -> None:
    drift = walk(seed)
    limits = [raw(drift + 305.0, 0.1), raw(drift + 102.03, 0.1)]
    found = search(frames({0x2A3: limits, 0x310: [np.arange(10 * SECONDS) % 256]}))
    assert not {"current", "voltage"} <= {*found.clear}
    assert all(each.evidence < 1.0 for each in found.candidates["current"])


def pack(nominal_v: float) -> Candidate:
    amps = load(1)
    words = [raw(amps + 800.0, 0.05), raw(375.0 - 0.1 * amps, 0.05)]
    return search(frames({0x2A1: words}), nominal_v).candidates["voltage"][0]


def test_a_rare_scale_of_some_bits_does_not_fit_a_stated_voltage_better() -> None:
    amps = load(1) / 10.0
    words = [raw(amps, 0.1, -500.0), raw(376.6 - 0.05 * amps, 0.1)]
    voltage = search(frames({0x2A1: words}), nominal_v=360.0).candidates["voltage"][0]
    assert (voltage.name, voltage.scale) == ("0x2A1 16|16@1+", 0.1)  # not its lower byte of 2 V


def test_the_stated_voltage_decides_and_what_else_fits_is_listed() -> None:
    sure = pack(373.0)
    assert (sure.scale, sure.levels) == (0.05, ())
    open_ = pack(350.0)
    assert len(open_.levels) > 1


def parked(folder: Path) -> Path:
    """Write a capture of a parked car: a voltage and a current at rest, and what drifts."""
    rng = np.random.default_rng(4)
    rest = raw(rng.normal(0.4, 0.2, 10 * SECONDS), 0.1) & 0xFFFF
    layout = {
        0x100: [raw(370.0 + 0.02 * walk(5), 0.1), rest],
        0x102: [raw(31_320.0 + 400.0 * walk(6), 1.0), np.arange(10 * SECONDS) % 256],
    }
    with can.CanutilsLogWriter(folder / "parked.log") as writer:
        for message in frames(layout):
            writer.on_message_received(message)
    return folder / "parked.log"


@pytest.mark.parametrize("choice", [(), ("--choose", "current=1", "--choose", "voltage=1")])
def test_a_parked_car_gets_no_map(tmp_path: Path, choice: tuple[str, ...]) -> None:
    path = parked(tmp_path)
    done = in_process("init", path, "-o", tmp_path / "out", *choice)
    assert done.code == 1
    assert done.out.startswith("No map: no voltage follows a current in steps")
    assert done.err.endswith(": record a drive\n")
    assert not (tmp_path / "out").exists()
    reached = [
        max(-each.low, each.high) for each in search(open_capture(path)).candidates["current"]
    ]
    assert max(reached, default=0.0) <= 1500.0


@pytest.mark.parametrize(("volts", "is_pack"), [(40.0, True), (120.0, False)])
def test_a_pack_sags_by_no_more_than_a_fifth(volts: float, is_pack: bool) -> None:
    amps = load(1)
    words = [raw(amps, 0.1, -500.0), raw(370.0 - volts / 150.0 * amps, 0.1)]
    found = search(frames({0x100: words}))
    assert ("0x100 16|16@1+" in {each.name for each in found.candidates["voltage"]}) == is_pack


def test_few_steps_of_the_current_prove_nothing() -> None:
    amps = np.where(np.arange(10 * SECONDS) < 5 * SECONDS, 1.0, 80.0)
    amps += np.random.default_rng(3).normal(0.0, 0.3, len(amps))
    found = search(frames({0x100: [raw(amps, 0.1, -500.0), raw(370.0 - 0.1 * amps, 0.1)]}))
    assert not found.has_steps


@pytest.mark.parametrize(("capacity_ah", "mark"), [(10.0, "1 ✓"), (5.0, "1 ?"), (None, "1 ?")])
def test_a_soc_is_ticked_where_it_agrees_with_the_charge(
    tmp_path: Path, capacity_ah: float | None, mark: str
) -> None:
    amps = load(1)
    drawn_ah = np.cumsum(amps) * 0.1 / 3600.0
    soc = 90.0 - 100.0 * drawn_ah / (capacity_ah or 10.0)
    if capacity_ah is None:  # of something else: it falls with time
        soc = 90.0 - np.linspace(0.0, 10.0, len(amps)) ** 2 / 10.0
    words = [raw(amps, 0.1, -500.0), raw(370.0 - 0.1 * amps, 0.1), raw(soc, 0.1)]
    signals = ["BMS", f"PackI {AMPS}", f"PackU {VOLTS}", 'SoC (0.1,0) [0|0] "%"']
    write(tmp_path, frames({0x100: words}), {0x100: signals})
    given = ("--dbc", tmp_path / "car.dbc", "-o", tmp_path / "out")
    done = in_process("init", tmp_path / "d.log", *given)
    assert done.code == 0, done.err
    assert mark in done.out.partition("soc")[2].replace("  ", " ")
    assert "SoC: " in done.err


def test_a_soc_moves_no_further_than_the_charge() -> None:
    amps = load(1)
    soc = raw(90.0 - 100.0 * np.cumsum(amps) * 0.1 / 3600.0 / 10.0, 0.5)
    noise = np.random.default_rng(5).integers(0, 256, len(amps))
    words = [raw(amps, 0.1, -500.0), raw(370.0 - 0.1 * amps, 0.1)]
    found = search(frames({0x100: words, 0x102: [256 * soc + noise]}))
    first, *_ = found.candidates["soc_reference"]
    assert first.bits == {(0x102, False, bit) for bit in range(8, 16)}


def pair_of(amps: np.ndarray) -> list[np.ndarray]:
    """Return a current and the voltage that follows it as a pack's does, not exactly."""
    noise = np.random.default_rng(7).normal(0.0, 0.4, len(amps))
    return [raw(amps, 0.1, -500.0), raw(370.0 - 0.1 * amps + noise, 0.1)]


def test_what_falls_with_time_is_no_soc() -> None:
    amps = load(1)
    drawn_ah = np.cumsum(amps) * 0.1 / 3600.0
    falls = {
        0x102: [raw(90.0 - 2.0 * drawn_ah, 0.05)],
        0x104: [raw(80.0 - 5.0 * np.linspace(0.0, 1.0, len(amps)), 0.05)],
    }
    words = pair_of(amps)
    found = search(frames({0x100: words, **falls}))
    assert {each.stream.arbitration_id for each in found.candidates["soc_reference"]} == {0x102}
    still = search(frames({0x100: words, 0x104: falls[0x104]}))
    assert still.candidates["soc_reference"] == []
    assert any("no SoC field found" in remark for remark in still.remarks)


def test_a_soc_is_found_beside_bits_of_the_voltage() -> None:
    amps = load(1)
    current, voltage = pair_of(amps)
    soc = raw(90.0 - 100.0 * np.cumsum(amps) * 0.1 / 3600.0 / 20.0, 0.4)
    payload = np.stack([voltage % 256, voltage // 256, soc, current % 256, current // 256], axis=1)
    found = search(
        can.Message(0.1 * row, 0x100, data=bytes(data), is_extended_id=False)
        for row, data in enumerate(payload.tolist())
    )
    assert [each.name for each in found.candidates["soc_reference"]] == ["0x100 23|8@0+"]


def with_open_soc(amps: np.ndarray) -> dict[int, list[np.ndarray]]:
    """Return a pair and a SoC: either byte beside the one that moves may be its upper one."""
    low, one = soc_of(amps) % 256, np.ones(len(amps), dtype=int)
    return {0x100: pair_of(amps), 0x102: [one + 256 * low, 2 * one]}  # 512 or 256 steps more


def soc_of(amps: np.ndarray) -> np.ndarray:
    return raw(90.0 - 100.0 * np.cumsum(amps) * 0.1 / 3600.0 / 20.0, 0.1)


def test_a_soc_is_open_also_if_its_other_reading_is_not_shown() -> None:
    amps = load(1)
    # Two other fields are as probable as the first reading.
    found = search(frames({**with_open_soc(amps), 0x104: [soc_of(amps)], 0x106: [soc_of(amps)]}))
    shown = [each.stream.arbitration_id for each in found.candidates["soc_reference"]]
    assert shown == [0x102, 0x104, 0x106]
    assert "soc_reference" not in found.clear


def test_a_soc_whose_bits_are_open_is_left_to_the_user(tmp_path: Path) -> None:
    write(tmp_path, frames(with_open_soc(load(1))), {})
    call = ("init", tmp_path / "d.log", "-o", tmp_path / "out", "--nominal-voltage", "370")
    call += ("--choose", "current=1", "--choose", "voltage=1")
    done = in_process(*call)
    assert done.code == 0, done.err
    assert "take one by --choose soc=N" in done.err
    assert "[soc_reference]" not in (tmp_path / "out" / "car.toml").read_text(encoding="utf-8")
    done = in_process(*call, "--force", "--choose", "soc=2")
    assert done.code == 0, done.err
    assert "[soc_reference]" in (tmp_path / "out" / "car.toml").read_text(encoding="utf-8")
