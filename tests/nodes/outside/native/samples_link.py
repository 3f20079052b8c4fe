"""An endpoint whose calls are noted, and a program that speaks bytes."""

from __future__ import annotations

import contextlib
import queue
import socket
import struct
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from events import CameraAnnouncement, CameraInfo, ImuAnnouncement
from nodes.outside.native import Endpoint, LinkAnswer, describe
from runtime.workers.output import plain_lines

HEADER_PATH = Path(__file__).parents[4] / "nodes" / "outside" / "native"
LIMIT = 40.0
"""Real seconds after which what should come counts as not coming."""

CAMERA = CameraAnnouncement(
    stamp=0,
    source="drone/camera",
    images=("rgb", "depth"),
    info=CameraInfo.from_fov(8, 6, 1.5),
    rate=30.0,
    latency=0.04,
    frame_id="optical",
    parent_frame_id="base_link",
    position=(0.3, 0.0, 0.1),
    orientation=(0.5, 0.5, 0.5, 0.5),
)
IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="imu",
    gyroscope_noise_density=1e-3,
    gyroscope_random_walk=1e-5,
    accelerometer_noise_density=1e-2,
    accelerometer_random_walk=1e-4,
)
INPUTS = [("imu", "imu", IMU)]
DESCRIPTION = describe(
    [(CAMERA, ["rgb8", "depth32f"])], INPUTS, {"kind": "lockstep"}, outputs=["fused"]
)


class Noted:
    """An endpoint, and queues of what it called."""

    def __init__(self, path: Path, slots: int = 2, **settings: Any) -> None:
        self.answers: queue.Queue[LinkAnswer] = queue.Queue()
        self.gone: queue.Queue[str] = queue.Queue()
        self.logs: queue.Queue[str] = queue.Queue()
        self.path = path
        self.endpoint = Endpoint(
            path,
            DESCRIPTION,
            slots=slots,
            slot_bytes=8 * 6 * 7,
            answered=self.answers.put,
            gone=self.gone.put,
            logged=self._log,
            **settings,
        )

    def _log(self, text: bytearray) -> None:
        for line in plain_lines(text):
            self.logs.put(line)

    def answer(self) -> LinkAnswer:
        return self.answers.get(timeout=LIMIT)

    def reason(self) -> str:
        return self.gone.get(timeout=LIMIT)


@contextlib.contextmanager
def listening(path: Path, slots: int = 2, **settings: Any) -> Iterator[Noted]:
    noted = Noted(path, slots, **settings)
    noted.endpoint.listen()
    try:
        yield noted
    finally:
        noted.endpoint.close()


class Raw:
    """A program that sends what it is told to."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.settimeout(LIMIT)
        self.socket.connect(str(path))

    def send(self, kind: int, body: bytes = b"") -> None:
        self.socket.sendall(struct.pack("<II", len(body), kind) + body)

    def receive(self) -> tuple[int, bytes]:
        length, kind = struct.unpack("<II", self.socket.recv(8, socket.MSG_WAITALL))
        return kind, self.socket.recv(length, socket.MSG_WAITALL) if length else b""

    def greet(self, name: bytes = b"raw") -> tuple[int, bytes]:
        self.send(1, b"VISNAVLK" + struct.pack("<II", 2, 0) + name)
        return self.receive()

    def get_ready(self, pose_of: int = 0, promises: bool = False) -> None:
        assert self.greet()[0] == 2
        self.send(4, struct.pack("<II", pose_of, promises))

    def close(self) -> None:
        self.socket.close()


@contextlib.contextmanager
def program(path: Path) -> Iterator[Raw]:
    raw = Raw(path)
    try:
        yield raw
    finally:
        raw.close()


def images(value: int = 7) -> list[tuple[int, str, Any]]:
    colours = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3) + np.uint8(value)
    return [(0, "rgb8", colours), (0, "depth32f", np.full((6, 8), value, np.float32))]


def pose(sequence: int, stamp: int, matrix: Any = None, status: int = 0) -> bytes:
    """The body of a POSE, as docs/reference/link.md has it."""
    rows = (np.eye(4) if matrix is None else np.asarray(matrix))[:3]
    return struct.pack("<QqIIII", sequence, stamp, status, 0, 0, 0) + rows.astype("<f8").tobytes()


def stamped_poses(poses: Mapping[int, Any]) -> bytes:
    """The body of a TRAJECTORY, as docs/reference/link.md has it, of poses by stamp."""
    return b"".join(
        struct.pack("<q12d", stamp, *np.asarray(matrix)[:3].ravel())
        for stamp, matrix in poses.items()
    )


def compiled(source: Path, folder: Path, *flags: str) -> Path:
    """Compile a C++ program of the native interface."""
    target = folder / source.stem
    command = ["c++", "-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(
        [*command, *flags, f"-I{HEADER_PATH}", str(source), "-o", str(target)], check=True
    )
    return target
