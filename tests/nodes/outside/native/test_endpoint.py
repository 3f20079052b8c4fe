"""One program at a time, of whom nothing breaks the run."""

from __future__ import annotations

import contextlib
import queue
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events.geometry import inverse, pose_matrix
from nodes.outside.native import LinkError, LinkTrajectory, endpoint
from nodes.outside.native.client import RECORDS, Frame, Link
from tests.nodes.outside.native.samples_link import (
    CAMERA,
    LIMIT,
    Noted,
    Raw,
    images,
    listening,
    pose,
    program,
    stamped_poses,
)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Noted]:
    with listening(tmp_path / "s") as noted:
        yield noted


def done(sequence: int, stamp: int) -> bytes:
    return struct.pack("<Qq", sequence, stamp)


def test_nobody_comes(run: Noted) -> None:
    with pytest.raises(LinkError, match=r"expected a program, found none within 0.01 s"):
        run.endpoint.wait(0.01)
    assert not run.endpoint.send_frame(0, images())
    assert not run.endpoint.send_input(0, 0, np.zeros(1, RECORDS["imu"]))


def test_a_program_that_is_not_ready_is_named(run: Noted) -> None:
    with program(run.path) as raw:
        assert raw.greet(b"slow")[0] == 2
        with pytest.raises(LinkError, match="found slow, which did not say READY"):
            run.endpoint.wait(0.05)
        assert not run.endpoint.send_frame(0, images())


def test_a_program_that_goes_before_it_is_ready_is_named_at_once(run: Noted) -> None:
    with program(run.path) as raw:
        raw.greet(b"short")
    with pytest.raises(LinkError, match="found short: its connection has ended"):
        run.endpoint.wait(LIMIT)
    assert run.gone.empty()


@pytest.mark.parametrize(
    ("hello", "reason"),
    [
        (b"VISNAVLK" + struct.pack("<II", 1, 0) + b"old", "expected version 2 of the protocol"),
        (b"VISNAVLX" + struct.pack("<II", 2, 0) + b"x", "expected HELLO with b'VISNAVLK'"),
        (b"", "expected HELLO"),
    ],
)
def test_a_program_of_another_version_or_none_is_refused(
    run: Noted, hello: bytes, reason: str
) -> None:
    with program(run.path) as raw:
        raw.send(1, hello)
        kind, body = raw.receive()
        assert (kind, body[:12]) == (3, b"VISNAVLK" + struct.pack("<I", 2))
        assert reason in body[16:].decode()
        assert raw.socket.recv(1) in (b"\x08", b"")  # BYE's header, or the end
    if hello[:8] == b"VISNAVLK":
        with pytest.raises(LinkError, match=r"found old: expected version 2 .* found 1"):
            run.endpoint.wait(LIMIT)
    with program(run.path) as raw:  # another may come
        raw.get_ready()
        assert run.endpoint.wait(LIMIT) == "raw"


def test_what_speaks_no_protocol_is_refused(run: Noted) -> None:
    with program(run.path) as raw:
        raw.socket.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        kind, _ = raw.receive()
        assert kind in (3, 5)
    with program(run.path):
        pass  # one that looks whether a run is there
    with program(run.path) as raw:
        raw.get_ready()
        assert run.endpoint.wait(LIMIT) == "raw"


def test_a_second_program_is_refused_and_the_first_goes_on(run: Noted) -> None:
    with program(run.path) as first, program(run.path) as second:
        assert first.greet()[0] == 2
        kind, body = second.greet(b"late")
        assert (kind, body[16:]) == (3, b"expected one program, found raw connected")
        first.send(4, struct.pack("<II", 0, 0))
        assert run.endpoint.wait(LIMIT) == "raw"
        assert run.endpoint.send_frame(5, images())
        assert first.receive()[0] == 17
        first.send(33, done(0, 5))
        assert run.answer().stamp == 5
    assert run.reason() == "raw: its connection has ended"


def test_one_that_is_slow_to_speak_holds_nobody_up(run: Noted) -> None:
    """Of all who connect, each byte may come by itself."""
    with program(run.path) as first, program(run.path) as other:
        first.get_ready()
        run.endpoint.wait(LIMIT)
        assert run.endpoint.send_frame(5, images())
        hello = struct.pack("<II", 20, 1) + b"VISNAVLK" + struct.pack("<II", 2, 0) + b"slow"
        answer = struct.pack("<II", 16, 33) + done(0, 5)
        for n in range(max(len(hello), len(answer))):
            other.socket.sendall(hello[n : n + 1])
            first.socket.sendall(answer[n : n + 1])
        assert run.answer().stamp == 5
        assert other.receive() == (
            3,
            b"VISNAVLK" + struct.pack("<II", 2, 0) + b"expected one program, found raw connected",
        )


def test_one_that_never_greets_is_disconnected(run: Noted, monkeypatch: pytest.MonkeyPatch) -> None:
    with program(run.path) as first:
        first.get_ready()
        run.endpoint.wait(LIMIT)
        monkeypatch.setattr(endpoint, "GREETING_TIME", 0.0)
        monkeypatch.setattr(endpoint, "_LOOK", 0.01)
        with program(run.path) as silent:
            assert silent.receive() == (5, b"its connection has ended")
        assert run.endpoint.send_frame(5, images())


def test_a_socket_that_a_dead_run_left_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(tmp_path / "s"))
    with listening(tmp_path / "s") as run, program(run.path) as raw:
        raw.get_ready()
        assert run.endpoint.wait(LIMIT) == "raw"


def test_a_living_run_and_a_file_keep_their_place(run: Noted, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    long = tmp_path / ("x" * 120)
    for path in (run.path, tmp_path / "file", tmp_path / "missing" / "s", long):
        other = Noted(path)
        with pytest.raises(LinkError, match="expected a place for a socket, found: "):
            other.endpoint.listen()
        other.endpoint.close()
    assert (tmp_path / "file").read_text() == "mine"
    with program(run.path) as raw:
        raw.get_ready()
        assert run.endpoint.wait(LIMIT) == "raw"


def test_a_frame_waits_for_a_slot_and_answers_may_come_in_any_order(run: Noted) -> None:
    with program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        assert run.endpoint.send_frame(10, images())
        assert run.endpoint.send_frame(11, images())
        assert not run.endpoint.send_frame(12, images(), wait=False)
        sent: queue.Queue[bool] = queue.Queue()
        thread = threading.Thread(target=lambda: sent.put(run.endpoint.send_frame(12, images())))
        thread.start()
        with pytest.raises(queue.Empty):
            sent.get(timeout=0.02)  # real time passes without an answer
        raw.send(33, done(1, 11))
        assert sent.get(timeout=LIMIT)
        thread.join()
        raw.send(33, done(0, 10))
        raw.send(33, done(0, 10))  # twice: whoever owes it counts it
        raw.send(33, done(2, 12))
        assert [run.answer().sequence for _ in range(4)] == [1, 0, 0, 2]
        frames = [struct.unpack_from("<Qq", raw.receive()[1]) for _ in range(3)]
        assert frames == [(0, 10), (1, 11), (2, 12)]
        assert run.endpoint.send_frame(13, images(), wait=False)
        assert run.endpoint.send_frame(14, images(), wait=False)
        assert not run.endpoint.send_frame(15, images(), wait=False)


def test_what_was_skipped_frees_its_slots_and_nothing_else_does(tmp_path: Path) -> None:
    with listening(tmp_path / "s", slots=3) as run, program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        for stamp in range(3):
            assert run.endpoint.send_frame(stamp, images())
        raw.send(33, done(1, 1))
        assert run.answer().stamp == 1
        assert run.endpoint.send_frame(3, images(), wait=False)
        assert not run.endpoint.send_frame(4, images(), wait=False)
        run.endpoint.release(1)
        assert run.endpoint.send_frame(4, images(), wait=False)
        assert not run.endpoint.send_frame(5, images(), wait=False)  # 2, 3 and 4 are out
        raw.send(33, done(0, 0))  # skipped, and answered after all
        assert run.answer().stamp == 0
        assert not run.endpoint.send_frame(5, images(), wait=False)


@pytest.mark.parametrize("how", ["killed", "close"])
def test_nothing_waits_for_a_program_that_is_gone(run: Noted, how: str) -> None:
    with program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        while run.endpoint.send_frame(0, images(), wait=False):
            pass
        sent: queue.Queue[bool] = queue.Queue()
        thread = threading.Thread(target=lambda: sent.put(run.endpoint.send_frame(9, images())))
        thread.start()
        raw.close() if how == "killed" else run.endpoint.close()
        assert not sent.get(timeout=LIMIT)
        thread.join()
    if how == "killed":
        assert run.reason() == "raw: its connection has ended"
    else:
        assert run.gone.empty()


@pytest.mark.slow
def test_close_does_not_wait_for_a_program_that_reads_nothing(run: Noted) -> None:
    with program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        samples = np.zeros(100_000, RECORDS["imu"])
        thread = threading.Thread(target=lambda: run.endpoint.send_input(0, 0, samples))
        thread.start()
        begin = time.monotonic()
        run.endpoint.close()
        assert time.monotonic() - begin < LIMIT
        thread.join(LIMIT)
        assert not thread.is_alive()
        run.endpoint.close()


@pytest.mark.parametrize(
    ("kind", "body", "named"),
    [
        (32, pose(5, 0), "sequence: expected below 1, found 5"),
        (32, pose(0, 1), "stamp: expected 0 of frame 0, found 1"),
        (33, b"", "DONE: expected 16 bytes, found 0"),
        (4, struct.pack("<II", 0, 0), "found type 4"),
        (17, b"", "found type 17"),
        (36, b"", "a promised TRAJECTORY, LOG or BYE, found type 36"),
        (32, pose(0, 0, np.full((4, 4), np.inf)), "POSE.pose: expected finite"),
    ],
)
def test_a_program_that_breaks_the_protocol_is_told_and_let_go(
    run: Noted, kind: int, body: bytes, named: str
) -> None:
    with program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        run.endpoint.send_frame(0, images())
        raw.receive()
        raw.send(kind, body)
        assert named in run.reason()
        said = raw.receive()
        assert said[0] == 5
        assert named in said[1].decode()
    assert run.answers.empty()
    with program(run.path) as raw:  # it may come back, and begins anew
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        assert run.endpoint.send_frame(7, images())
        assert struct.unpack_from("<Qq", raw.receive()[1]) == (0, 7)


def test_goodbye_is_told(run: Noted) -> None:
    with program(run.path) as raw:
        raw.get_ready()
        run.endpoint.wait(LIMIT)
        raw.send(5, b"no map")
        assert run.reason() == "raw: it said goodbye no map"


def test_ready_names_whose_poses_come(run: Noted) -> None:
    with program(run.path) as raw:
        assert raw.greet()[0] == 2
        raw.send(4, struct.pack("<II", 9, 0))
        assert raw.receive()[0] == 3
        with pytest.raises(LinkError, match=r"READY.pose_of: expected 0 or 1"):
            run.endpoint.wait(LIMIT)


def test_ready_promises_a_trajectory_or_none(run: Noted) -> None:
    with program(run.path) as raw:
        assert raw.greet()[0] == 2
        raw.send(4, struct.pack("<II", 0, 2))
        with pytest.raises(LinkError, match=r"READY.trajectory: expected 0 or 1, found 2"):
            run.endpoint.wait(LIMIT)
    for promised in (False, True):
        with program(run.path) as raw:
            raw.get_ready(promises=promised)
            run.endpoint.wait(LIMIT)
            assert run.endpoint.promised == promised
            raw.send(5)
            run.reason()
    assert not run.endpoint.promised
    with pytest.raises(LinkError, match="expected a program with its trajectory, found none"):
        run.endpoint.finish(LIMIT)


def finished(
    run: Noted, raw: Raw, *messages: tuple[int, bytes], seconds: float = LIMIT
) -> LinkTrajectory:
    """Finish a program that answers BYE with messages."""

    def reply() -> None:
        assert raw.receive() == (5, b"")
        for message in messages:
            raw.send(*message)

    replying = threading.Thread(target=reply)
    replying.start()
    try:
        return run.endpoint.finish(seconds)
    finally:
        replying.join()


@pytest.mark.parametrize("pose_of", [0, 1])
@pytest.mark.parametrize("answered", [False, True])
def test_the_trajectory_is_in_the_frame_of_the_poses_before_it(
    run: Noted, pose_of: int, answered: bool
) -> None:
    """Or begins with the identity, if there are none."""
    body_from_camera = pose_matrix(CAMERA.position, CAMERA.orientation)
    cameras = [pose_matrix((n, 2, 3), (0.5, 0.5, 0.1 * n, 0.5)) for n in (4, 5, 6)]
    said = [camera @ inverse(body_from_camera) if pose_of else camera for camera in cameras]
    with program(run.path) as raw:
        raw.get_ready(pose_of, promises=True)
        run.endpoint.wait(LIMIT)
        run.endpoint.send_frame(0, images())
        raw.receive()
        raw.send(*((32, pose(0, 0, said[1])) if answered else (33, struct.pack("<Qq", 0, 0))))
        run.answer()
        trajectory = finished(run, raw, (36, stamped_poses({7: said[0], 8: said[2]})))
    assert trajectory.stamps.tolist() == [7, 8]
    origin = inverse(cameras[1 if answered else 0])
    for found, camera in zip(trajectory.poses, (cameras[0], cameras[2]), strict=True):
        assert found == pytest.approx(origin @ camera, abs=1e-12)
    assert run.gone.empty()  # its end was expected


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (None, r"none in the 0\.05 s left of grace"),
        ((5, b"no map"), "it said goodbye no map"),
        ((36, bytes(105)), "TRAJECTORY: expected 104 bytes a pose, found 105 in all"),
    ],
)
def test_a_trajectory_that_does_not_come_is_an_error_with_the_reason(
    run: Noted, message: tuple[int, bytes] | None, reason: str
) -> None:
    with program(run.path) as raw:
        raw.get_ready(promises=True)
        run.endpoint.wait(LIMIT)
        messages = [message] if message else []
        with pytest.raises(LinkError, match=f"raw: expected its trajectory, found {reason}"):
            finished(run, raw, *messages, seconds=LIMIT if messages else 0.05)
    assert run.gone.empty()


def test_a_trajectory_before_the_end_breaks_the_protocol(run: Noted) -> None:
    with program(run.path) as raw:
        raw.get_ready(promises=True)
        run.endpoint.wait(LIMIT)
        raw.send(36)
        assert "TRAJECTORY: expected it after the run's BYE, found it before" in run.reason()


def test_a_second_trajectory_is_logged_and_the_first_counts(run: Noted) -> None:
    with program(run.path) as raw:
        raw.get_ready(promises=True)
        run.endpoint.wait(LIMIT)
        first = stamped_poses({1: np.eye(4)})
        assert finished(run, raw, (36, first), (36, b"")).stamps.tolist() == [1]
        expected = "after the run: TRAJECTORY: expected one, found a second"
        assert run.logs.get(timeout=LIMIT) == expected


@pytest.mark.parametrize("of", [0, 1])
def test_poses_are_relative_to_the_first(run: Noted, of: int) -> None:
    """In whatever frame a program has them; of the camera, though it gives those of the body."""
    body_from_camera = pose_matrix(CAMERA.position, CAMERA.orientation)
    world = pose_matrix((1, 2, 3), (0.1, 0.7, 0.5, 0.5))
    cameras = [pose_matrix((0.1 * n, 0, 0.2 * n), (1 - 0.1 * n, 0.1 * n, 0, 0)) for n in range(3)]
    with program(run.path) as raw:
        raw.get_ready(of)
        run.endpoint.wait(LIMIT)
        for n, camera in enumerate(cameras):
            run.endpoint.send_frame(n, images())
            raw.receive()
            given = world @ camera @ (inverse(body_from_camera) if of else np.eye(4))
            raw.send(32, pose(n, n, given))
            got = run.answer().pose
            assert got is not None
            np.testing.assert_allclose(got, camera, atol=1e-12)


def test_poses_whose_first_is_the_identity_arrive_to_the_last_bit(run: Noted) -> None:
    turned = pose_matrix((0.1, 1 / 3, -7e-9), (0.9, 0.1, -0.3, 0.2))
    with Link("exact", str(run.path)) as link:
        link.ready()
        run.endpoint.wait(LIMIT)
        for n, matrix in enumerate([np.eye(4), turned]):
            run.endpoint.send_frame(n, images())
            frame = link.receive()
            assert isinstance(frame, Frame)
            link.pose(frame, matrix)
            got = run.answer().pose
            assert got is not None
            assert got.tobytes() == matrix.tobytes()


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        ((0, "bgr8", np.zeros((6, 8, 3), np.uint8)), "expected one of mono8, rgb8"),
        ((0, "rgb8", np.zeros((6, 8), np.uint8)), "rgb8: expected uint8 of shape"),
        ((0, "mono8", np.zeros((6, 8), np.float32)), "mono8: expected uint8"),
        ((0, "rgb8", np.zeros((60, 80, 3), np.uint8)), "expected images of"),
    ],
)
def test_an_image_that_does_not_fit_is_the_callers_error(
    run: Noted, image: tuple[int, str, np.ndarray], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        run.endpoint.send_frame(0, [image])


def test_more_rows_than_fit_into_a_message_are_the_callers_error(run: Noted) -> None:
    with pytest.raises(ValueError, match="expected at most 524287 rows in a message, found 524288"):
        run.endpoint.send_input(0, 0, np.zeros(524_288, RECORDS["lidar_scan"]))


def test_strided_images_arrive(run: Noted) -> None:
    whole = np.arange(12 * 16, dtype=np.uint8).reshape(12, 16)
    with Link("p", str(run.path)) as link:
        link.ready()
        run.endpoint.wait(LIMIT)
        run.endpoint.send_frame(0, [(0, "mono8", whole[::2, ::-2])])
        frame = link.receive()
        assert isinstance(frame, Frame)
        assert np.array_equal(frame.image("mono8"), whole[::2, ::-2])
        with pytest.raises(LookupError, match="expected an image rgb8 of camera 0, found mono8"):
            frame.image("rgb8")
        with pytest.raises(ValueError, match="read-only"):
            frame.image("mono8")[0, 0] = 1


@settings(
    max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(data=st.binary(max_size=400), ready=st.booleans())
def test_no_bytes_break_the_run(run: Noted, data: bytes, ready: bool) -> None:
    """Garbage before and after READY; whoever comes next is served."""
    with program(run.path) as raw:
        if ready:
            raw.get_ready()
            run.endpoint.wait(LIMIT)
            assert run.endpoint.send_frame(0, images())
        with contextlib.suppress(ConnectionError):  # the rest of what was sent is not read
            raw.socket.sendall(data)
            raw.socket.shutdown(socket.SHUT_WR)
            while raw.socket.recv(4096):
                pass
    if ready:
        assert run.reason()
    while not run.logs.empty():
        run.logs.get()
