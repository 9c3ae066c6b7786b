"""A line a second at most, and the last of those that came sooner."""

from __future__ import annotations

from cangauge._logging import Voice


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_the_first_is_said_at_once_and_the_last_of_many_a_second_later() -> None:
    clock, said = Clock(), list[str]()
    voice = Voice(said.append, clock)
    voice.say("down")
    assert said == ["down"]
    for number in range(5):
        clock.now_s += 0.1
        voice.say(f"try {number}")
    assert said == ["down"]
    clock.now_s = 100.99
    voice.look()
    assert said == ["down"]
    clock.now_s = 101.0
    voice.look()
    voice.look()
    assert said == ["down", "try 4 (lines left out: 4)"]


def test_however_often_it_speaks_it_is_heard_once_a_second() -> None:
    clock, said = Clock(), list[str]()
    voice = Voice(said.append, clock)
    for _ in range(1000):
        voice.say("flapping")
        clock.now_s += 0.01
    assert len(said) == 10
