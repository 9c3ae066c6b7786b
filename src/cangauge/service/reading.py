"""Read configuration, model and vehicle; while the service runs, in another process.

A DBC is parsed in Python: in a thread it would take the interpreter from the receive loop for
seconds. The other process has the lowest priority, a limit of memory, and a limit of time after
which it is killed; what it read comes back as a pickle of our own classes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cangauge._io import MAX_READING_MEMORY, READ_WITHIN_S, time_limit
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.model.model_file import Model
from cangauge.service.config import RunConfig

ReadConfig = Callable[[], RunConfig]

START_S: Final = 10.0
"""Time for the other process to start and to end, beside its limit for reading [s]."""


@dataclass(frozen=True)
class Reading:
    """A configuration with the files that it names.

    Parameters
    ----------
    config : RunConfig
    vehicle : Vehicle
    model : Model
    vehicle_key : tuple
        Identity of the vehicle: its options, and the content of its files.
    """

    config: RunConfig
    vehicle: Vehicle
    model: Model
    vehicle_key: tuple[object, ...]

    @classmethod
    def of(cls, read: ReadConfig, within_s: float = READ_WITHIN_S) -> Reading:
        """Read in this process.

        Raises
        ------
        InputError
            If something is invalid, or takes too long (see `time_limit`).
        """
        with time_limit("the configuration and its files", within_s):
            config = read()
            vehicle, model = config.load_vehicle(), Model.load(config.model)
            config.check_poll(vehicle)
            try:
                return cls(config, vehicle, model, _vehicle_key(config, vehicle))
            except OSError as error:  # a file disappeared meanwhile
                raise InputError(f"cannot be read: {error}", cure="try again") from error


def _vehicle_key(config: RunConfig, vehicle: Vehicle) -> tuple[object, ...]:
    files = [*vehicle.dbc_files, *([config.map] if config.map is not None else [])]
    contents = tuple(hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files)
    chosen = (config.messages, config.rules, config.checks)
    return (config.vehicle, config.temperature, config.pair_within_s, chosen, *contents)


class BackgroundReader:
    """Read in another process, once for each request.

    Parameters
    ----------
    read : callable
        Returns the configuration; can be pickled.
    within_s : float, optional
        Limit of time [s].
    """

    def __init__(self, read: ReadConfig, within_s: float | None = None) -> None:
        self._read = read
        self._within_s = within_s
        self._is_requested = False
        self._thread: threading.Thread | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._result: Reading | InputError | None = None

    def request(self) -> None:
        """Begin to read; once more at its end if it is under way, as files may have changed."""
        self._is_requested = True
        self._begin()

    @property
    def is_reading(self) -> bool:
        """Whether a result is still to come."""
        return self._thread is not None

    def poll(self) -> Reading | InputError | None:
        """Return what was read, or why it is refused, once; None while there is nothing new."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread, result = None, self._result
        self._begin()
        return result

    def close(self) -> None:
        """End the other process."""
        self._is_requested = False
        if self._child is not None:
            self._child.kill()

    def _begin(self) -> None:
        if self._is_requested and self._thread is None:
            self._is_requested = False
            self._thread = threading.Thread(target=self._run, name="cangauge-reload", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        within_s = READ_WITHIN_S if self._within_s is None else self._within_s
        try:
            self._result = self._from_child(within_s)
        except InputError as error:
            self._result = error
        except Exception as error:  # noqa: BLE001 - no process, memory or descriptor left
            self._result = InputError(f"cannot be read: {error!r}", cure="try again")

    def _from_child(self, within_s: float) -> Reading | InputError:
        # -P: no module is imported from the working folder. The same interpreter, our own module.
        command = [sys.executable, "-P", "-m", "cangauge.service.reading"]
        hidden = {"NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"}
        environment = {name: text for name, text in os.environ.items() if name not in hidden}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        self._child = subprocess.Popen(  # noqa: S603 - as above
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        with self._child as child:
            try:
                answer, _ = child.communicate(
                    pickle.dumps((self._read, within_s)), within_s + START_S
                )
            except subprocess.TimeoutExpired:
                raise InputError(
                    f"takes more than {within_s:g} s to read",
                    source="the configuration and its files",
                    cure="make the DBC, the map or the model smaller",
                ) from None
            finally:
                child.kill()
        if not answer:
            raise InputError(
                f"reading it ended with status {child.returncode}",
                source="the configuration and its files",
                cure="is there memory enough? Make the DBC or the model smaller",
            )
        found: Reading | InputError = pickle.loads(answer)  # noqa: S301 - from our own process
        return found


def _limit_resources() -> None:
    """Leave processor and memory to the service, as far as the system allows."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, 19)
    with contextlib.suppress(OSError):  # the kernel ends this process first when memory is short
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - not on Windows

    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_READING_MEMORY, MAX_READING_MEMORY))


def _main() -> None:
    """Answer one request: a pickled function and a limit [s] on stdin, the result on stdout."""
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # meant for the service
    # Nothing that a library prints may mix with the answer.
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _limit_resources()
    read, within_s = pickle.load(sys.stdin.buffer)  # noqa: S301 - from the service
    result: Reading | InputError
    try:
        result = Reading.of(read, within_s)
    except InputError as error:
        result = error
    except MemoryError:
        raise  # the parent names the cure
    except Exception as error:  # noqa: BLE001 - of any library that reads a file
        result = InputError(f"cannot be read: {error!r}", cure="try again, or check the files")
    pickle.dump(result, answer)
    answer.flush()


if __name__ == "__main__":
    # Pickles name the module, not the script that Python runs as `__main__`.
    from cangauge.service.reading import _main as main

    main()
    os._exit(0)
