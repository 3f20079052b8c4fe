"""Both clients see the same and say the same: one suite, run against each in a process."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nodes.outside.native.client import RECORDS
from tests.nodes.outside.native.samples_link import (
    CAMERA,
    HEADER_PATH,
    LIMIT,
    compiled,
    images,
    listening,
)

HERE = Path(__file__).parent
pytestmark = pytest.mark.timeout(180)  # a compiler with sanitizers has much to do
NO_COMPILER = shutil.which("c++") is None


@pytest.fixture(scope="module", params=["python", pytest.param("c++", marks=pytest.mark.slow)])
def mirror(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[list[str]]:
    """The command of the program that answers with what it sees."""
    if request.param == "python":
        yield [sys.executable, str(HERE / "mirror.py")]
        return
    if NO_COMPILER:
        pytest.skip("c++: not found")
    flags = "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    yield [str(compiled(HERE / "mirror.cpp", tmp_path_factory.mktemp("c++"), *flags))]


def started(command: list[str], path: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "VISNAV_SOCKET": str(path), "PYTHONPATH": str(HEADER_PATH)}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, error = process.communicate(timeout=LIMIT)
    return process.returncode, error.strip()


def test_frames_and_answers(mirror: list[str], tmp_path: Path) -> None:
    with listening(tmp_path / "s", slots=3) as run:
        process = started(mirror, run.path)
        assert run.endpoint.wait(LIMIT) == "mirror"
        focal = round(1000 * CAMERA.info.fx)
        assert run.logs.get(timeout=LIMIT) == f"drone/camera 8 plumb_bob 5 {focal} lockstep"
        origin = None
        for n in range(10):
            samples = np.zeros(n, RECORDS["imu"])
            samples["stamp"] = np.arange(n)
            samples["angular_velocity"][:, 2] = 0.5
            samples["linear_acceleration"][:, 0] = 0.25
            run.endpoint.send_input(0, 7, samples[: n // 2])
            run.endpoint.send_input(0, 8, samples[n // 2 :])
            sent = images(n)
            assert run.endpoint.send_frame(100 + n, sent)
            answer = run.answer()
            assert (answer.sequence, answer.stamp) == (n, 100 + n)
            statuses = {2: "lost", 6: "initialising", 3: "done"}
            status = statuses.get(n % 8, statuses.get(n % 4, "tracked"))
            assert answer.status == status
            assert (answer.pose is not None) == (status == "tracked")
            if answer.pose is None:
                continue
            seen = sent[0][2].sum(), sent[1][2].sum(), n * (n - 1) / 2 + 0.75 * n
            if origin is None:
                origin = np.array(seen, float)
            assert answer.pose[:3, 3].tolist() == (np.array(seen) - origin).tolist()
            if n % 4 == 1:
                assert answer.pose[:3, :3].tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
                assert answer.covariance is not None
                assert answer.covariance.ravel().tolist() == [n + k for k in range(36)]
                assert answer.velocity is not None
                assert answer.velocity.tolist() == [n, 2, 3]
                assert answer.points.tolist() == [[1, 2], [3, 4]]
                assert answer.inliers.tolist() == [True, False]
            else:
                assert answer.covariance is None
                assert answer.points.shape == (0, 2)
        trajectory = run.endpoint.finish(LIMIT)
        assert trajectory.stamps.tolist() == [100 + n for n in range(10)]
        assert origin is not None
        expected = np.array([[n, 0, 0] for n in range(10)]) - origin
        assert trajectory.poses[:, :3, 3].tolist() == expected.tolist()
        assert ended(process) == (0, "")


def test_the_run_dies(mirror: list[str], tmp_path: Path) -> None:
    """The end of a run that says nothing is an error."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        process = started(mirror, tmp_path / "s")
        connection, _ = listener.accept()
        connection.recv(8)
        connection.close()
        code, error = ended(process)
    assert code == 3
    assert "the run is gone" in error


@pytest.mark.slow
@pytest.mark.parametrize("kind", [2, 3])
def test_the_run_has_another_version(mirror: list[str], tmp_path: Path, kind: int) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        process = started(mirror, tmp_path / "s")
        connection, _ = listener.accept()
        with connection:
            connection.recv(100)
            body = b"VISNAVLK" + struct.pack("<II", 7, 0) + b"expected version 7, found 1"
            connection.sendall(struct.pack("<II", len(body), kind) + body)
            code, error = ended(process)
    assert code == 3
    assert "version" in error
    assert "7" in error


NOT_OF_A_RUN = {
    "samples cut off": struct.pack("<II", 19, 16) + struct.pack("<IIq", 0, 1, 0) + b"abc",
    "rows of no input": struct.pack("<II", 16, 16) + struct.pack("<IIq", 9, 0, 0),
    "fewer rows than said": struct.pack("<II", 16, 16) + struct.pack("<IIq", 0, 2, 0),
    "too long": struct.pack("<II", 2**31, 16),
    "sequence": struct.pack("<II", 24, 17) + struct.pack("<QqII", 3, 0, 0, 0),
    "many images": struct.pack("<II", 24, 17) + struct.pack("<QqII", 0, 0, 2**32 - 1, 0),
    "offset": struct.pack("<II", 56, 17)
    + struct.pack("<QqIIIIIIIIQ", 0, 0, 1, 0, 0, 2, 6, 8, 24, 0, 2**64 - 64),
    "size": struct.pack("<II", 56, 17)
    + struct.pack("<QqIIIIIIIIQ", 0, 0, 1, 0, 0, 3, 2**31, 2**31, 2**32 - 4, 0, 0),
    "kind": struct.pack("<II", 56, 17)
    + struct.pack("<QqIIIIIIIIQ", 0, 0, 1, 0, 0, 9, 1, 1, 4, 0, 0),
    "type": struct.pack("<II", 0, 99),
    "goodbye with a reason": struct.pack("<II", 4, 5) + b"why?",
    "half a header": b"\1\0",
}


@pytest.mark.slow
@pytest.mark.parametrize("message", NOT_OF_A_RUN.values(), ids=NOT_OF_A_RUN.keys())
def test_what_no_run_sends_is_an_error(mirror: list[str], tmp_path: Path, message: bytes) -> None:
    with listening(tmp_path / "s") as run:
        process = started(mirror, run.path)
        run.endpoint.wait(LIMIT)
        peer = run.endpoint._program
        assert peer is not None
        peer.connection.sendall(message)
        with contextlib.suppress(OSError):  # it may have gone already
            peer.connection.shutdown(socket.SHUT_RDWR)
        code, error = ended(process)
        assert code == 3, error
        assert error
        assert "Sanitizer" not in error


def test_it_is_killed_with_all_slots_taken(mirror: list[str], tmp_path: Path) -> None:
    with listening(tmp_path / "s") as run:
        process = started(mirror, run.path)
        run.endpoint.wait(LIMIT)
        process.send_signal(19)  # SIGSTOP: it answers nothing
        threads = [
            threading.Thread(target=run.endpoint.send_frame, args=(n, images())) for n in range(3)
        ]
        for thread in threads:
            thread.start()
        process.kill()
        assert "mirror: its connection has ended" in run.reason()
        for thread in threads:
            thread.join(LIMIT)
            assert not thread.is_alive()
        ended(process)


@pytest.mark.slow
@pytest.mark.skipif(NO_COMPILER, reason="c++: not found")
def test_nothing_is_at_the_socket(mirror: list[str], tmp_path: Path) -> None:
    code, error = ended(started(mirror, tmp_path / "nothing"))
    assert code == 3
    assert "expected the socket of a run" in error
