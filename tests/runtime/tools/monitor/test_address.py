"""Where runs listen, and how they are found."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from runtime.errors import VisnavError
from runtime.tools.monitor.protocol import find, runs, socket_of
from runtime.user_folder import user_folder


@pytest.fixture
def listening(sockets: Path) -> Iterator[socket.socket]:
    """Listen where this process's run ``tour`` does."""
    with closing(socket.socket(socket.AF_UNIX)) as server:
        server.bind(str(socket_of("tour")))
        server.listen()
        yield server


def test_the_folder_is_its_users_alone(sockets: Path) -> None:
    assert user_folder() == sockets
    assert sockets.stat().st_mode & 0o777 == 0o700
    sockets.chmod(0o755)
    with pytest.raises(VisnavError, match="only its user may enter, found mode 755"):
        user_folder()


def test_a_folder_that_cannot_be_is_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(VisnavError, match="visnav: expected a folder for sockets: Not a directory"):
        runs()


def test_a_run_has_an_address_however_long_its_name(sockets: Path) -> None:
    assert socket_of("a b").name == f"a_b-{os.getpid()}.sock"
    assert len(os.fsencode(socket_of("é" * 200))) <= 100


def test_a_run_is_found_by_name_or_alone(listening: socket.socket) -> None:
    path = socket_of("tour")
    assert runs() == {"tour": path}
    assert find(None) == find("tour") == find(str(path)) == path
    with pytest.raises(VisnavError, match=r"expected one of tour; found 'tuor' \(did you mean"):
        find("tuor")


def test_of_several_runs_one_must_be_named(listening: socket.socket, sockets: Path) -> None:
    with closing(socket.socket(socket.AF_UNIX)) as other:
        other.bind(str(sockets / "tour-1.sock"))
        other.listen()
        assert sorted(runs()) == sorted(["tour-1", f"tour-{os.getpid()}"])
        with pytest.raises(VisnavError, match="expected the name of one of several runs: tour-"):
            find(None)


def test_what_a_killed_run_left_is_removed(sockets: Path) -> None:
    with closing(socket.socket(socket.AF_UNIX)) as dead:
        dead.bind(str(socket_of("tour")))
    with pytest.raises(VisnavError, match="expected a run to look at, found none"):
        find(None)
    assert list(sockets.iterdir()) == []
