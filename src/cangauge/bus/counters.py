"""What happened to the frames: counted in total and for every wanted message."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field


@dataclass(slots=True)
class MessageCounters:
    """Fate of the frames of one wanted message."""

    wanted: int = 0
    """Frames with its id."""
    crc_errors: int = 0
    """Refused: the CRC is wrong."""
    counter_repeats: int = 0
    """Refused: the counter stands still."""
    counter_jumps: int = 0
    """Good frames that came after a loss."""
    frames_lost: int = 0
    """Frames that the counter says are missing."""
    short: int = 0
    """Refused: fewer bytes than the DBC says."""
    not_available: int = 0
    """Values refused because the code means "not available"."""
    implausible: int = 0
    """Values refused because they are out of range or changed too fast."""
    stuck: int = 0
    """Values refused because the signal stands still while it should move."""
    held_back: int = 0
    """Good values not used yet, because too many before them failed."""


@dataclass(slots=True)
class Counters:
    """Fate of all frames.

    Parameters
    ----------
    messages : dict of int to MessageCounters
        By key: arbitration id, plus `vehicle.EXTENDED` for an extended one.
    """

    messages: dict[int, MessageCounters] = field(default_factory=dict)
    frames: int = 0
    """Frames handed over, wanted or not."""
    ignored: int = 0
    """Error frames and remote frames."""
    samples: int = 0
    """Samples made."""
    current_unpaired: int = 0
    """Samples without a voltage (voltage NaN)."""
    voltage_unpaired: int = 0
    """Voltages that found no current, and were dropped."""
    time_reversals: int = 0
    """Frames of a wanted message stamped earlier than the one before."""

    def _sum(self, name: str) -> int:
        return sum(getattr(each, name) for each in self.messages.values())

    @property
    def wanted(self) -> int:
        """Frames with a wanted id."""
        return self._sum("wanted")

    @property
    def crc_errors(self) -> int:
        """Frames refused for a wrong CRC."""
        return self._sum("crc_errors")

    @property
    def counter_repeats(self) -> int:
        """Frames refused because their counter stands still."""
        return self._sum("counter_repeats")

    @property
    def counter_jumps(self) -> int:
        """Good frames that came after a loss."""
        return self._sum("counter_jumps")

    @property
    def frames_lost(self) -> int:
        """Frames that the counters say are missing."""
        return self._sum("frames_lost")

    @property
    def short(self) -> int:
        """Frames refused because they have fewer bytes than the DBC says."""
        return self._sum("short")

    @property
    def not_available(self) -> int:
        """Values refused because their code means "not available"."""
        return self._sum("not_available")

    @property
    def implausible(self) -> int:
        """Values refused because they are out of range or changed too fast."""
        return self._sum("implausible")

    @property
    def stuck(self) -> int:
        """Values refused because their signal stands still while it should move."""
        return self._sum("stuck")

    @property
    def held_back(self) -> int:
        """Good values not used yet, because too many before them failed."""
        return self._sum("held_back")

    def to_dict(self) -> dict[str, object]:
        """Return totals, and the counters of every message by its id ("0x1DB")."""
        totals = {
            name: getattr(self, name)
            for name in (
                "frames",
                "wanted",
                "ignored",
                "samples",
                "current_unpaired",
                "voltage_unpaired",
                "time_reversals",
                "crc_errors",
                "counter_repeats",
                "counter_jumps",
                "frames_lost",
                "short",
                "not_available",
                "implausible",
                "stuck",
                "held_back",
            )
        }
        per_message = {
            f"0x{key & 0x1FFFFFFF:X}": asdict(each) for key, each in self.messages.items()
        }
        return {**totals, "messages": per_message}
