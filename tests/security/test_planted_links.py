"""What another user planted under a name that we write: his link is replaced or refused."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from _pytest.mark import ParameterSet

from cangauge._files import atomic_path, write_text_atomic
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.service.lifecycle import sole_writer
from cangauge.service.pipeline import Pipeline
from cangauge.service.state import StateKeeper, read_state
from cangauge.service.status_client import StatusSocket
from live import frames_of, in_process, leaf_model, leaf_model_path, short_log

fcntl = pytest.importorskip("fcntl")
IS_ROOT = sys.platform != "win32" and os.geteuid() == 0
pytestmark = pytest.mark.skipif(not IS_ROOT, reason="root plants links as another user")
ANOTHER = 65534
VICTIM = 65533
BRIEF = Path(__file__).with_name("brief.toml")
RUN = ("run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "planted")


def planted(link: Path, target: Path, owner: int = ANOTHER) -> None:
    link.symlink_to(target)
    os.lchown(link, owner, owner)


@pytest.fixture
def shared() -> Iterator[Path]:
    """Make a folder as `/tmp` is: everybody writes, nobody removes another's files."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o1777)
        yield Path(name)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a drive as a log and as a capture, and a model of it."""
    folder = tmp_path_factory.mktemp("made")
    paths = {"DRIVE": folder / "drive.csv", "CAPTURE": folder / "x.log", "MODEL": folder / "m.json"}
    write_log(short_log(600.0), paths["DRIVE"])
    with can.CanutilsLogWriter(paths["CAPTURE"]) as log:
        for frame in frames_of(short_log(), shift_s=1e9):
            log(frame)
    assert in_process("fit", paths["DRIVE"], *CAPACITY, "-o", paths["MODEL"]).code == 0
    return paths


def slow(*values: object) -> ParameterSet:
    return pytest.param(*values, marks=pytest.mark.nightly)


CAPACITY = ("--capacity-ah", 60)
WRITERS = [
    ("twin --seed 1 --hours 0.05 -o OUT/log.csv", "log.csv"),
    ("estimate DRIVE -m MODEL -o OUT/soc.csv", "soc.csv"),
    ("estimate DRIVE -m MODEL -o OUT/soc.parquet", "soc.parquet"),
    ("inspect DRIVE --report OUT/page.html", "page.html"),
    ("fit DRIVE --capacity-ah 60 -o OUT/m.json --report OUT/m.html", "m.json m.html"),
    ("gap DRIVE -m MODEL --report OUT/gap.html", "gap.html"),
    (
        "judge DRIVE -m MODEL -o OUT/m.json --corrected OUT/c.csv --report OUT/j.html",
        "m.json c.csv j.html",
    ),
    ("init CAPTURE --force -o OUT", "run.toml"),
    slow("estimate DRIVE -m MODEL -o OUT/soc.csv --report OUT/soc.html", "soc.csv soc.html"),
    slow("export-fmu -m MODEL -o OUT/x.fmu", "x.fmu"),
    slow("fleet estimate DRIVE -m MODEL -o OUT/x.parquet", "x.parquet"),
    slow("fleet gap DRIVE -m MODEL -o OUT/x.parquet", "x.parquet"),
    slow("fleet judge DRIVE -m MODEL -o OUT/x.parquet", "x.parquet"),
]


@pytest.mark.parametrize(("line", "names"), WRITERS)
def test_a_command_does_not_write_through_a_planted_link(
    line: str, names: str, shared: Path, made: dict[str, Path]
) -> None:
    mine = shared / "mine"
    mine.write_text("mine")
    for name in names.split():
        planted(shared / name, mine)
    words = [str(made.get(word, word)).replace("OUT", str(shared)) for word in line.split()]
    ended = in_process(*words)
    assert ended.code == 0, ended.err
    assert mine.read_text() == "mine"
    assert not any((shared / name).is_symlink() for name in names.split())


def test_sources_in_place_of_a_planted_link_are_refused(shared: Path) -> None:
    mine = shared / "mine"
    mine.write_text("mine")
    planted(shared / "cangauge_model.c", mine)
    ended = in_process("export-c", "-m", leaf_model_path(), "-o", shared)
    assert (ended.code, mine.read_text()) == (2, "mine")
    assert "not from an export" in ended.err


def test_a_recording_does_not_begin_in_a_file_of_another_name(shared: Path) -> None:
    planted(shared / "drive.log", shared / "victims.log")
    assert in_process(*RUN, "--config", BRIEF, "--record", shared / "drive.log").code == 0
    assert not (shared / "victims.log").exists()


@pytest.mark.parametrize("name", ["s.json", ".s.json.part", ".s.json.lock"])
def test_state_and_lock_do_not_follow_a_planted_link(name: str, shared: Path) -> None:
    mine, state = shared / "mine", shared / "s.json"
    mine.write_text('{"format": "cangauge-state", "mine": 1}')
    before = mine.read_bytes()
    planted(shared / name, mine)
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    with sole_writer(state), StateKeeper(state, pipeline, "virtual x", 86400.0):
        for frame in frames_of(short_log()):
            pipeline.handle(frame)
    assert mine.read_bytes() == before
    assert read_state(state).bus == "virtual x"


def test_rights_of_a_planted_file_are_not_taken_over(shared: Path) -> None:
    path = shared / "model.json"
    path.touch()
    path.chmod(0o666)
    os.chown(path, ANOTHER, ANOTHER)
    leaf_model().save(path)
    assert path.stat().st_uid == 0
    assert path.stat().st_mode & 0o022 == 0


def test_a_planted_pipe_is_replaced(shared: Path) -> None:
    os.mkfifo(shared / "x.txt")
    os.chown(shared / "x.txt", ANOTHER, ANOTHER)
    write_text_atomic(shared / "x.txt", "text")
    assert (shared / "x.txt").is_file()


def test_a_planted_folder_is_refused(shared: Path, tmp_path: Path) -> None:
    planted(shared / "out", tmp_path)
    with pytest.raises(InputError, match=r"out is a link of another user"):
        write_text_atomic(shared / "out" / "x.txt", "text")
    assert list(tmp_path.iterdir()) == []


def test_no_folder_is_made_through_a_planted_link(shared: Path, tmp_path: Path) -> None:
    planted(shared / "out", tmp_path)
    ended = in_process("export-c", "-m", leaf_model_path(), "-o", shared / "out" / "deep")
    assert ended.code == 2
    assert "out is a link of another user" in ended.err
    assert list(tmp_path.iterdir()) == []


def test_no_folder_of_a_status_socket_is_made_through_a_planted_link(
    shared: Path, tmp_path: Path
) -> None:
    planted(shared / "out", tmp_path)
    with pytest.raises(InputError, match="out is a link of another user"):
        StatusSocket(shared / "out" / "deep" / "s.sock", dict)
    assert list(tmp_path.iterdir()) == []


def test_an_own_link_that_leads_to_a_planted_one_stops_there(shared: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("mine")
    planted(shared / "x.txt", mine)
    (tmp_path / "link.txt").symlink_to(shared / "x.txt")
    write_text_atomic(tmp_path / "link.txt", "text")
    assert mine.read_text() == "mine"
    assert (shared / "x.txt").read_text() == "text"


def test_own_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "names").symlink_to("folder")
    (tmp_path / "link.txt").symlink_to("names/../folder/mine.txt")
    write_text_atomic(tmp_path / "link.txt", "text")
    assert (tmp_path / "folder" / "mine.txt").read_text() == "text"
    assert (tmp_path / "link.txt").is_symlink()


def test_a_link_to_itself_is_replaced(tmp_path: Path) -> None:
    for name in ("x.txt", "folder"):
        (tmp_path / name).symlink_to(name)
    write_text_atomic(tmp_path / "x.txt", "text")
    assert not (tmp_path / "x.txt").is_symlink()
    with pytest.raises(InputError, match="Too many levels of symbolic links"):
        write_text_atomic(tmp_path / "folder" / "x.txt", "text")


def test_a_service_starts_with_a_state_that_links_to_itself(tmp_path: Path) -> None:
    state = tmp_path / "cangauge-state.json"
    state.symlink_to(state)
    ended = in_process(*RUN, "--config", BRIEF, "--state", state)
    assert ended.code == 0, ended.err
    assert "Traceback" not in ended.err


@pytest.mark.parametrize("rights", [0o1777, 0o777])
def test_an_exchanged_temporary_file_is_not_written_through(rights: int, tmp_path: Path) -> None:
    mine, folder = tmp_path / "mine", tmp_path / "folder"
    mine.write_text("mine")
    mine.chmod(0o600)
    folder.mkdir()
    folder.chmod(rights)
    (folder / "x.txt").touch(0o644)

    def write() -> None:
        with atomic_path(folder / "x.txt") as part:
            (temporary,) = folder.glob(".x*")
            temporary.unlink()
            planted(temporary, mine)
            part.write_text("text")

    with pytest.raises(InputError, match="another user has exchanged it"):
        write()
    assert mine.read_text() == "mine"
    assert mine.stat().st_mode & 0o777 == 0o600
    assert [each.name for each in folder.iterdir()] == ["x.txt"]


def as_victim(work: Callable[[], None]) -> int:
    """Run `work` as a user without rights; return 0 if it raises nothing, 1 for InputError."""
    child = os.fork()
    if child == 0:
        code = 9
        try:
            os.setresgid(VICTIM, VICTIM, VICTIM)
            os.setresuid(VICTIM, VICTIM, VICTIM)
            work()
            code = 0
        except InputError as error:
            code = 1 if "another user" in str(error) else 2
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_user_without_rights_is_told_of_a_planted_link(shared: Path) -> None:
    mine = shared / "mine"
    mine.write_text("mine")
    os.chown(mine, VICTIM, VICTIM)
    planted(shared / "x.txt", mine)
    assert as_victim(lambda: write_text_atomic(shared / "x.txt", "text")) == 1
    assert mine.read_text() == "mine"
    assert sorted(each.name for each in shared.iterdir()) == ["mine", "x.txt"]


def test_a_lock_of_another_user_stops_no_start(shared: Path) -> None:

    own = shared / "own"
    own.mkdir()
    lock = own / ".s.json.lock"
    lock.touch()
    lock.chmod(0o666)
    for path in (own, lock):
        os.chown(path, VICTIM, VICTIM)
    os.chown(lock, ANOTHER, ANOTHER)

    def start() -> None:
        with sole_writer(own / "s.json"):
            pass

    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert as_victim(start) == 0


def test_a_state_of_another_user_is_not_trusted(shared: Path) -> None:
    state = shared / "cangauge-state.json"
    state.write_text('{"format": "cangauge-state"}')
    os.chown(state, ANOTHER, ANOTHER)
    ended = in_process(*RUN, "--config", BRIEF, "--state", state)
    assert ended.code == 0
    assert "belongs to another user" in ended.err


def test_a_link_of_another_user_to_an_own_state_is_not_trusted(shared: Path) -> None:
    saved, state = shared / "earlier.json", shared / "cangauge-state.json"
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    with StateKeeper(saved, pipeline, "virtual planted", 86400.0):
        for frame in frames_of(short_log()):
            pipeline.handle(frame)
    planted(state, saved)
    ended = in_process(*RUN, "--config", BRIEF, "--state", state)
    assert ended.code == 0
    assert "belongs to another user" in ended.err
    assert saved.exists()
