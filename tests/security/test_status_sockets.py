"""`cangauge status` trusts no socket that anybody could have made, and sends a socket no token."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cangauge.errors import CangaugeError
from cangauge.service import addresses
from cangauge.service.addresses import TOKEN_VARIABLE, served_sockets
from cangauge.service.status_client import fetch_status
from live import in_process

needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs files of another user"
)
SOMEBODY = 12345


@contextmanager
def listening(path: Path) -> Iterator[list[bytes]]:
    """Accept connections and refuse requests; collect what is sent."""
    received: list[bytes] = []
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.listen(8)

    def answer() -> None:
        while True:
            try:
                client, _ = server.accept()
            except OSError:
                return
            with client:
                received.append(client.recv(4096))
                if received[-1]:
                    client.sendall(b"HTTP/1.1 500 \x1b[2J\r\nContent-Length: 6\r\n\r\n\x1b[2Jno")

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    try:
        yield received
    finally:
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        thread.join(5.0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder that is searched, in one like /tmp."""
    shared = tmp_path / "tmp"
    folder = shared / "cangauge-0"
    folder.mkdir(parents=True)
    shared.chmod(0o1777)
    folder.chmod(0o700)
    monkeypatch.setattr(addresses, "_folders", lambda: [folder])
    monkeypatch.setattr(addresses, "SYSTEM_FOLDER", tmp_path / "none")
    return folder


@needs_root
def test_only_own_sockets_in_own_folders_are_found(folder: Path) -> None:
    path = folder / "can0.sock"
    with listening(path):
        assert served_sockets() == [path]
        os.lchown(path, SOMEBODY, SOMEBODY)
        assert served_sockets() == []
        os.lchown(path, 0, 0)
        os.lchown(folder, SOMEBODY, SOMEBODY)
        assert served_sockets() == []
        os.lchown(folder, 0, 0)
        folder.chmod(0o777)
        assert served_sockets() == []
        folder.chmod(0o700)
        folder.rename(folder.with_name("real"))
        folder.symlink_to("real")
        os.lchown(folder, SOMEBODY, SOMEBODY)
        assert served_sockets() == []
        folder.unlink()
        folder.with_name("real").rename(folder)
        folder.parent.chmod(0o755)  # nobody else can have made it there
        os.lchown(path, SOMEBODY, SOMEBODY)
        assert served_sockets() == [path]


def test_a_socket_gets_no_token(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "a-token-of-some-length")
    token_file = folder / "token"
    token_file.write_text("a-token-of-some-length")
    path = folder / "can0.sock"
    with listening(path) as received:
        with pytest.raises(CangaugeError):
            fetch_status(str(path))
        ended = in_process("status", "--endpoint", path, "--token-file", token_file)
    assert ended.code == 1
    assert "\x1b" not in ended.err
    assert len(received) == 2
    assert all(b"GET /status" in each and b"token" not in each for each in received)
