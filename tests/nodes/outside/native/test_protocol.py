"""The bytes of docs/reference/link.md, with its offsets as literals, at both ends."""

from __future__ import annotations

import contextlib
import inspect
import json
import mmap
import os
import re
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nodes.outside.native import LinkError
from nodes.outside.native.answers import read_done, read_order, read_pose, read_trajectory
from nodes.outside.native.client import RECORDS, Frame, Link, ProtocolError
from tests.nodes.outside.native.samples_link import (
    LIMIT,
    Raw,
    images,
    listening,
    pose,
    program,
    stamped_poses,
)

ROOT = Path(__file__).parents[4]
QUICK = settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)


def u32(data: bytes, at: int) -> int:
    return int(struct.unpack_from("<I", data, at)[0])


def test_the_run_speaks_as_the_page_says(tmp_path: Path) -> None:
    with listening(tmp_path / "s") as run, program(run.path) as raw:
        raw.send(1, b"VISNAVLK\x02\x00\x00\x00\x00\x00\x00\x00my program")
        head, fds, *_ = socket.recv_fds(raw.socket, 8, 1)
        length, kind = u32(head, 0), u32(head, 4)
        body = raw.socket.recv(length, socket.MSG_WAITALL)
        assert kind == 2
        assert body[:8] == b"VISNAVLK"
        assert u32(body, 8) == 2
        (size,) = struct.unpack_from("<Q", body, 16)
        description = json.loads(body[24:])
        assert description["clock"] == {"kind": "lockstep"}
        assert description["cameras"][0]["images"] == ["rgb8", "depth32f"]
        assert description["cameras"][0]["info"]["width"] == 8
        assert np.array(description["cameras"][0]["body_from_camera"])[:3, 3].tolist() == [
            0.3,
            0.0,
            0.1,
        ]
        assert description["inputs"][0]["gyroscope_noise_density"] == 1e-3
        assert description["inputs"][0]["kind"] == "imu"
        assert description["outputs"] == ["fused"]
        raw.send(4, struct.pack("<II", 0, 0))
        assert run.endpoint.wait(LIMIT) == "my program"

        samples = np.zeros(2, RECORDS["imu"])
        samples["stamp"] = [-5, 2**60]
        samples["angular_velocity"][1] = [1, 2, 3]
        samples["linear_acceleration"][1] = [4, 5, 6]
        assert run.endpoint.send_input(0, -3, samples)
        kind, body = raw.receive()
        assert (kind, len(body)) == (16, 16 + 112)
        assert struct.unpack_from("<IIq", body, 0) == (0, 2, -3)
        assert struct.unpack_from("<q", body, 16) == (-5,)
        assert struct.unpack_from("<q", body, 16 + 56) == (2**60,)
        assert struct.unpack_from("<3d", body, 16 + 56 + 8) == (1, 2, 3)
        assert struct.unpack_from("<3d", body, 16 + 56 + 32) == (4, 5, 6)

        sent = images()
        assert run.endpoint.send_frame(-9, sent)
        kind, body = raw.receive()
        assert (kind, len(body)) == (17, 24 + 2 * 32)
        assert struct.unpack_from("<Qq", body, 0) == (0, -9)
        assert u32(body, 16) == 2
        memory = mmap.mmap(fds[0], size, prot=mmap.PROT_READ)
        for number, (at, code, row) in enumerate([(24, 2, 24), (56, 3, 32)]):
            assert [u32(body, at + n) for n in (0, 4, 8, 12, 16, 20)] == [0, code, 6, 8, row, 0]
            (offset,) = struct.unpack_from("<Q", body, at + 24)
            assert offset % 64 == 0
            assert memory[offset : offset + 6 * row] == sent[number][2].tobytes()
        memory.close()
        os.close(fds[0])

        raw.send(34, "läuft".encode())
        assert run.logs.get(timeout=LIMIT) == "läuft"
        raw.send(33, struct.pack("<Qq", 0, -9))
        done = run.answer()
        assert (done.sequence, done.stamp, done.status, done.pose) == (0, -9, "done", None)
        run.endpoint.close()
        assert raw.receive() == (5, b"")
    assert not (tmp_path / "s").exists()


def test_the_client_speaks_as_the_page_says(tmp_path: Path) -> None:
    """A run of bytes: what `Link` sends, and what it makes of what it gets."""
    fd = os.memfd_create("test")
    os.ftruncate(fd, 4096)
    os.pwrite(fd, bytes(range(12)), 64)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(tmp_path / "s"))
    listener.listen()
    sent: list[bytes] = []

    def run() -> None:
        connection, _ = listener.accept()
        connection.settimeout(LIMIT)
        with connection:
            raw = Raw.__new__(Raw)
            raw.socket = connection
            sent.append(raw.receive()[1])
            told = {"inputs": [{"name": "imu", "kind": "imu"}], "outputs": ["fused"]}
            body = b"VISNAVLK" + struct.pack("<IIQ", 2, 0, 4096) + json.dumps(told).encode()
            socket.send_fds(connection, [struct.pack("<II", len(body), 2)], [fd])
            connection.sendall(body)
            sent.append(raw.receive()[1])
            raw.send(16, struct.pack("<IIqq6d", 0, 1, 9, 3, 1, 2, 3, 4, 5, 6))
            head = struct.pack("<QqII", 0, 77, 1, 0)
            raw.send(17, head + struct.pack("<IIIIIIQ", 1, 1, 2, 3, 6, 0, 64))
            sent.extend(raw.receive()[1] for _ in range(6))
            raw.send(5)
            sent.append(raw.receive()[1])

    thread = threading.Thread(target=run)
    thread.start()
    with Link("näme", str(tmp_path / "s")) as link:
        link.ready(pose_of="body", trajectory=True)
        (frame,) = [frame for frame in link if _answer(link, frame)]
        link.trajectory([5, 77], np.stack([np.eye(4), 2 * np.eye(4)]))
    thread.join()
    listener.close()
    os.close(fd)
    assert sent[0] == b"VISNAVLK\2\0\0\0\0\0\0\0" + "näme".encode()
    assert sent[1] == struct.pack("<II", 1, 1)
    assert (frame.sequence, frame.stamp) == (0, 77)
    assert frame.image("mono8", camera=1).tolist() == [[0, 1, 2], [6, 7, 8]]
    assert [(batch.name, batch.arrived) for batch in frame.inputs] == [("imu", 9)]
    assert frame.rows("imu")["stamp"].tolist() == [3]
    assert frame.rows("imu")["angular_velocity"].tolist() == [[1, 2, 3]]
    assert frame.rows("imu")["linear_acceleration"].tolist() == [[4, 5, 6]]
    with pytest.raises(LookupError, match="expected one of imu, found 'gnss'"):
        frame.rows("gnss")

    further, order, full, lost, done, log, trajectory = sent[2:]
    assert struct.unpack_from("<QqIIII", further) == (0, 77, 0, 0, 0, 1)
    assert struct.unpack("<QqII8d", order) == (0, 77, 3, 1, 0, 0, 0, 1, 2, 3, 0, 0.5)
    assert struct.unpack_from("<QqIIII", full) == (0, 77, 0, 3, 2, 0)
    assert struct.unpack_from("<12d", full, 32) == (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)
    assert struct.unpack_from("<36d", full, 128) == tuple(range(36))
    assert struct.unpack_from("<3d", full, 128 + 288) == (7, 8, 9)
    assert struct.unpack_from("<4f", full, 128 + 312) == (1, 2, 3, 4)
    assert full[128 + 312 + 16 :] == b"\1\0"
    assert struct.unpack_from("<QqIIII", lost) == (0, 77, 1, 0, 0, 0)
    assert len(lost) == 128
    assert done == struct.pack("<Qq", 0, 77)
    assert log == "grüße".encode()
    assert len(trajectory) == 2 * 104
    assert struct.unpack_from("<q12d", trajectory) == (5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)
    assert struct.unpack_from("<q12d", trajectory, 104) == (77, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0)


def _answer(link: Link, frame: Any) -> bool:
    link.pose(frame, np.eye(4), output="fused")
    link.order(frame, "velocity", velocity=[1, 2, 3], yaw_rate=0.5, axes="heading")
    sure: dict[str, Any] = {"covariance": np.arange(36).reshape(6, 6), "velocity": [7, 8, 9]}
    link.pose(frame, np.eye(4), points=[[1, 2], [3, 4]], inliers=[True, False], **sure)
    link.lost(frame)
    link.done(frame)
    link.log("grüße")
    return True


@QUICK
@given(st.binary(max_size=500))
def test_no_body_of_an_answer_breaks_the_reader(body: bytes) -> None:
    for read in (read_pose, read_done):
        with contextlib.suppress(LinkError):
            answer = read(bytearray(body))
            assert answer.pose is None or np.isfinite(answer.pose).all()
    with contextlib.suppress(LinkError):
        order = read_order(bytearray(body))
        assert np.isfinite([*order.position, *order.velocity, order.yaw, order.yaw_rate]).all()


@QUICK
@given(st.data())
def test_an_answer_that_is_changed_anywhere_is_read_or_named(data: st.DataObject) -> None:
    """Bytes of a good POSE with points and covariance are changed, cut off, or added."""
    good = struct.pack("<QqIIII", 0, 0, 0, 1, 3, 0) + np.eye(4)[:3].tobytes()
    good += np.eye(6).tobytes() + bytes(3 * 9)
    body = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    body = body[: data.draw(st.integers(0, len(body)))] + data.draw(st.binary(max_size=2))
    with contextlib.suppress(LinkError):
        answer = read_pose(body)
        assert len(answer.points) == len(answer.inliers)
        assert np.isfinite(answer.points).all()


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (pose(0, 0)[:-1], "POSE: expected 128 bytes"),
        (pose(0, 0) + b"\0", "POSE: expected 128 bytes for 0 points, found 129"),
        (pose(0, 0, status=3), "POSE.status"),
        (struct.pack("<QqIIII", 0, 0, 0, 4, 0, 0) + bytes(96), "POSE.follows"),
        (struct.pack("<QqIIII", 0, 0, 0, 0, 2**32 - 1, 0) + bytes(96), "4294967295 points"),
        (pose(0, 0, np.full((4, 4), np.nan)), "POSE.pose: expected finite"),
        (pose(0, 0, np.zeros((4, 4))), "POSE.pose: expected a rotation"),
        (pose(0, 0, np.diag([1, 1, -1, 1])), "POSE.pose: expected a rotation"),
        (pose(0, 0, np.full((4, 4), 1e300)), "POSE.pose: expected at most 1e+09"),
    ],
)
def test_what_is_wrong_is_named(body: bytes, named: str) -> None:
    with pytest.raises(LinkError, match=named.replace("+", r"\+")):
        read_pose(bytearray(body))


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (bytes(103), "TRAJECTORY: expected 104 bytes a pose, found 103 in all"),
        (stamped_poses({5: np.eye(4), 4: np.eye(4)}), "rise strictly, found 4 after 5"),
        (stamped_poses({4: np.eye(4)}) * 2, "rise strictly, found 4 after 4"),
        (stamped_poses({2**63 - 1: np.eye(4), -(2**63): np.eye(4)}), "rise strictly"),
        (stamped_poses({4: np.eye(4), 5: np.full((4, 4), np.inf)}), "pose: expected finite"),
        (stamped_poses({4: np.eye(4), 5: np.zeros((4, 4))}), "pose: expected a rotation"),
        (stamped_poses({4: np.full((4, 4), 1e10), 5: np.eye(4)}), "pose: expected at most"),
    ],
)
def test_a_wrong_trajectory_is_named(body: bytes, named: str) -> None:
    with pytest.raises(LinkError, match=rf"TRAJECTORY.*{named}" if named[0].islower() else named):
        read_trajectory(bytearray(body))


def test_a_client_sends_no_trajectory_that_it_has_not_promised(tmp_path: Path) -> None:
    with listening(tmp_path / "s") as run, Link("x", str(run.path)) as link:
        link.ready()
        with pytest.raises(ProtocolError, match=r"expected ready\(trajectory=True\) before"):
            link.trajectory([1], [np.eye(4)])


@QUICK
@given(st.binary(max_size=3 * 104))
def test_no_body_of_a_trajectory_breaks_the_reader(body: bytes) -> None:
    with contextlib.suppress(LinkError):
        stamps, poses = read_trajectory(bytearray(body))
        assert poses.shape == (len(stamps), 4, 4)
        assert np.isfinite(poses).all()


def test_a_lost_pose_may_hold_anything() -> None:
    answer = read_pose(bytearray(pose(4, 5, np.full((4, 4), np.nan), status=1)))
    assert (answer.sequence, answer.stamp, answer.status, answer.pose) == (4, 5, "lost", None)


@pytest.mark.parametrize(
    ("reply", "said"),
    [
        ((3, b"VISNAVLK" + struct.pack("<II", 3, 0) + b"expected version 3"), "expected version 3"),
        ((2, b"VISNAVLK" + struct.pack("<IIQ", 1, 0, 64) + b"{}"), "the run has 1"),
        ((2, b"VISNAVLK" + struct.pack("<IIQ", 2, 0, 64) + b"{}"), "shared memory"),
        ((2, b"HTTP/1.1 400 Bad Request"), "something else"),
        ((9, b""), "something else"),
        (None, "without BYE"),
    ],
)
def test_a_client_says_why_it_cannot_join(
    tmp_path: Path, reply: tuple[int, bytes] | None, said: str
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()

        def run() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(100)
                if reply is not None:
                    connection.sendall(struct.pack("<II", len(reply[1]), reply[0]) + reply[1])
                    connection.settimeout(LIMIT)
                    connection.recv(100)  # a BYE, or the end

        thread = threading.Thread(target=run)
        thread.start()
        with pytest.raises(ProtocolError, match=said):
            Link("p", str(tmp_path / "s"))
        thread.join()


def test_a_client_says_that_there_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(ProtocolError, match=r"expected the socket of a run at .*nothing"):
        Link("p", str(tmp_path / "nothing"))


@QUICK
@given(
    st.lists(st.tuples(st.sampled_from([5, 16, 17, 18, 99]), st.binary(max_size=120)), max_size=5)
)
def test_no_run_breaks_a_client(tmp_path: Path, messages: list[tuple[int, bytes]]) -> None:
    """Whatever comes after WELCOME, frames end or a `ProtocolError` says what is wrong."""
    here, there = socket.socketpair()
    there.sendall(b"".join(struct.pack("<II", len(body), kind) + body for kind, body in messages))
    there.close()
    link = Link.__new__(Link)
    link._socket, link._expected, link._sending = here, 0, threading.Lock()
    link._memory = mmap.mmap(-1, 4096)
    link._kinds = {"imu": "imu", "vio": "pose_estimate"}
    with here, contextlib.suppress(ProtocolError):
        for frame in link:
            assert all(image.data.nbytes <= 4096 for image in frame.images)


def test_the_page_has_all_functions() -> None:
    """Whatever is public in either client stands on the page as it is declared."""
    page = (ROOT / "docs/reference/link.md").read_text(encoding="utf-8").partition("## All")[2]
    header = (ROOT / "nodes/outside/native/visnav_link.hpp").read_text(encoding="utf-8")
    header = re.sub(r"\nprivate:.*?\n};", "\n};", header, flags=re.DOTALL)
    shown, declared = (
        " ".join(re.sub(r"//.*", "", text).split())
        for text in (page.partition("```cpp\n")[2].partition("```")[0], header)
    )
    functions = re.findall(r"(?<=[;{}] )(?:explicit )?[\w:<>&* ]+\((?:[^;{}]|\{\})*(?=;)", shown)
    for function in functions:
        assert f" {function} " in declared, function
    public = set(re.findall(r"^    (?! |explicit D)[\w:<>&* ]*?\b(\w+)\(", header, re.MULTILINE))
    assert {"Link", "row", "from_quaternion", "pose", "done"} <= public
    for name in public:
        assert any(f" {name}(" in signature for signature in functions), name
    text = page.partition("```text\n")[2].partition("```")[0]
    for name, method in (*vars(Link).items(), ("image", Frame.image), ("rows", Frame.rows)):
        if inspect.isfunction(method) and not name.startswith("_"):
            named = list(inspect.signature(method).parameters.values())[1:]
            plain = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in named]
            assert f".{name}{inspect.Signature(plain)}".replace("'", '"') in text, name
