"""The native interface's client: feeds a Python program with a run's images and IMU samples.

This file may be copied; it needs numpy, and nothing else of the project::

    with Link("my_slam") as link:               # connects to the socket that $VISNAV_SOCKET names
        camera = link.description["cameras"][0]["info"]
        slam = MySlam(camera["fx"], camera["fy"], camera["cx"], camera["cy"])
        link.ready()
        for frame in link:                      # until the run ends
            pose = slam.track(frame.image("rgb8"), frame.image("depth32f"), frame.imu)
            link.lost(frame) if pose is None else link.pose(frame, pose)

docs/reference/link.md of visnav-runtime has the protocol, byte by byte. All is little endian.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import socket
import struct
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

MAGIC, VERSION = b"VISNAVLK", 1
HELLO, WELCOME, REFUSED, READY, BYE = 1, 2, 3, 4, 5
IMU, FRAME = 16, 17
POSE, DONE, LOG = 32, 33, 34

HEADER = struct.Struct("<II")  # of each message: length of its body (bytes), type
GREETING = struct.Struct("<8sII")  # begins HELLO, WELCOME and REFUSED: magic, version, 0
MEMORY = struct.Struct("<Q")  # follows in WELCOME: size of the shared memory (bytes)
FRAME_HEAD = struct.Struct("<QqII")  # sequence, stamp (ns), number of images, 0
IMAGE_HEAD = struct.Struct("<IIIIIIQ")  # camera, kind, height, width, stride (bytes), 0, offset
POSE_HEAD = struct.Struct("<QqIIII")  # sequence, stamp, status, what follows, number of points, 0
DONE_BODY = struct.Struct("<Qq")  # sequence, stamp (ns)
LONGEST, LONGEST_TEXT = 1 << 24, 4096  # bytes of a body; of a name, a reason, a line of the log

SAMPLE = np.dtype(
    [("stamp", "<i8"), ("angular_velocity", "<f8", 3), ("linear_acceleration", "<f8", 3)]
)
"""A sample of the IMU: ns, rad/s, m/s² in its own axes; 56 bytes."""

KINDS: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {
    "mono8": (1, np.dtype("u1"), ()),
    "rgb8": (2, np.dtype("u1"), (3,)),
    "depth32f": (3, np.dtype("<f4"), ()),
    "segmentation32i": (4, np.dtype("<i4"), ()),
}
"""Kinds of image: number, type of a value, values of a pixel."""

STATUS = {"tracked": 0, "lost": 1, "initialising": 2}
POSE_OF = {"camera": 0, "body": 1}
COVARIANCE, VELOCITY = 1, 2  # what follows a pose


class ProtocolError(ConnectionError):
    """The run refuses this program, has gone without a word, or does not keep to the protocol."""


class LinkImage(NamedTuple):
    """An image in shared memory: valid until its frame has been answered, read-only.

    Attributes:
        camera: Index in the description's cameras.
        kind: One of `KINDS`.
        data: Shape (height, width), or (height, width, 3) for rgb8; depth32f is metres along z,
            inf where there is none.
    """

    camera: int
    kind: str
    data: npt.NDArray[Any]


class Frame(NamedTuple):
    """Images and IMU samples of an exposure.

    Attributes:
        sequence: 0, 1, 2, …
        stamp: Time of the exposure (ns).
        images: All images.
        imu: Samples since the last frame, of type `SAMPLE`.
    """

    sequence: int
    stamp: int
    images: tuple[LinkImage, ...]
    imu: npt.NDArray[Any]

    def image(self, kind: str, camera: int = 0) -> npt.NDArray[Any]:
        """Return a camera's image of a kind; raise `LookupError` if there is none."""
        for image in self.images:
            if (image.camera, image.kind) == (camera, kind):
                return image.data
        found = ", ".join(f"{image.kind} of {image.camera}" for image in self.images)
        raise LookupError(f"expected an image {kind} of camera {camera}, found {found or 'none'}")


class Link:
    """Connection to a run. Any thread may answer; a single thread receives.

    Args:
        name: Of the program, for messages and the report.
        path: The run's socket; empty is $VISNAV_SOCKET.

    Raises:
        ProtocolError: There is no such run, or it refuses this program.
    """

    def __init__(self, name: str, path: str = "") -> None:
        path = path or os.environ.get("VISNAV_SOCKET", "")
        self._sending = threading.Lock()
        self._expected = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with contextlib.ExitStack() as unless_joined:
            unless_joined.callback(self._socket.close)
            try:
                self._socket.connect(path)
            except OSError as error:
                raise ProtocolError(f"expected the socket of a run at {path!r}: {error}") from None
            self._send(HELLO, GREETING.pack(MAGIC, VERSION, 0) + name.encode())
            self.description = self._welcome()
            unless_joined.pop_all()

    description: dict[str, Any]
    """Cameras, IMU and clock of the run."""

    def _welcome(self) -> dict[str, Any]:
        try:
            head, fds, *_ = socket.recv_fds(self._socket, HEADER.size, 1)
        except OSError as error:
            raise ProtocolError(f"the run is gone: {error}") from None
        try:
            kind, body = self._read(head)
            magic, version, _ = GREETING.unpack_from(body.ljust(GREETING.size, b"\0"))
            if magic != MAGIC or kind not in (WELCOME, REFUSED):
                raise ProtocolError("expected a run of visnav-runtime, found something else")
            if kind == REFUSED:
                raise ProtocolError(f"the run refuses: {text_of(body[GREETING.size :])}")
            if version != VERSION:
                problem = f"expected version {VERSION} of the protocol, the run has {version}"
                self._send(BYE, problem.encode())
                raise ProtocolError(problem)
            if len(fds) != 1 or len(body) < GREETING.size + MEMORY.size:
                raise ProtocolError("expected the run's shared memory with WELCOME, found none")
            (size,) = MEMORY.unpack_from(body, GREETING.size)
            if not 0 < size <= os.fstat(fds[0]).st_size:
                raise ProtocolError(f"expected shared memory of {size} bytes, found less")
            self._memory = mmap.mmap(fds[0], size, prot=mmap.PROT_READ)
        finally:
            for fd in fds:
                os.close(fd)
        return dict(json.loads(body[GREETING.size + MEMORY.size :]))

    def ready(self, pose_of: str = "camera") -> None:
        """Tell the run to begin, and whose poses come: of the optical camera 0, or the body."""
        self._send(READY, struct.pack("<II", POSE_OF[pose_of], 0))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames until the run ends, each with the IMU samples since the frame before."""
        samples = [np.empty(0, SAMPLE)]
        while (received := self.receive()) is not None:
            if isinstance(received, Frame):
                yield received._replace(imu=np.concatenate(samples))
                samples = samples[:1]
            else:
                samples.append(received)

    def receive(self) -> Frame | npt.NDArray[Any] | None:
        """Wait for a frame (without its samples) or samples; return `None` at the end of the run.

        Raises:
            ProtocolError: The run has gone without a word, or does not keep to the protocol.
        """
        kind, body = self._read()
        if kind == BYE and body:
            raise ProtocolError(f"the run has ended the connection: {text_of(body)}")
        if kind == BYE:
            return None
        if kind == IMU and len(body) % SAMPLE.itemsize == 0:
            return np.frombuffer(body, SAMPLE)
        if kind == FRAME:
            try:
                return self._frame(body)
            except (struct.error, ValueError) as error:
                raise ProtocolError(f"expected a frame, found {error}") from None
        raise ProtocolError(f"expected IMU, FRAME or BYE, found type {kind}, {len(body)} bytes")

    def _frame(self, body: bytearray) -> Frame:
        sequence, stamp, count, _ = FRAME_HEAD.unpack_from(body)
        if sequence != self._expected:
            raise ValueError(f"number {sequence} after {self._expected - 1}")
        if len(body) != FRAME_HEAD.size + count * IMAGE_HEAD.size:
            raise ValueError(f"{len(body)} bytes for {count} images")
        self._expected += 1
        images = []
        for camera, number, height, width, stride, _, offset in IMAGE_HEAD.iter_unpack(
            memoryview(body)[FRAME_HEAD.size :]
        ):
            kind = next((name for name, (code, *_) in KINDS.items() if code == number), "")
            if not kind:
                raise ValueError(f"an image of kind {number}")
            _, dtype, pixel = KINDS[kind]
            step = dtype.itemsize * math.prod(pixel)
            if width * step > stride or offset + height * stride > len(self._memory):
                raise ValueError("an image outside the shared memory")
            strides = (stride, step, dtype.itemsize)[: 2 + len(pixel)]
            data = np.ndarray((height, width, *pixel), dtype, self._memory, offset, strides)
            images.append(LinkImage(camera, kind, data))
        return Frame(sequence, stamp, tuple(images), np.empty(0, SAMPLE))

    def pose(
        self,
        frame: Frame,
        pose: npt.ArrayLike,
        *,
        covariance: npt.ArrayLike | None = None,
        velocity: npt.ArrayLike | None = None,
        points: npt.ArrayLike = (),
        inliers: npt.ArrayLike | None = None,
        status: str = "tracked",
    ) -> None:
        """Answer a frame with a pose.

        Args:
            pose: Transform from the optical camera (or the body: see `ready`) to a frame that
                stays the same, metres, shape (4, 4) or (3, 4).
            covariance: Of the pose's error: a shift along x, y, z and a rotation about them, all in
                that frame, m², m rad and rad², shape (6, 6).
            velocity: In that frame, metres per second, shape (3,).
            points: Features that were tracked: column and row, pixels, shape (n, 2).
            inliers: Which of them agree with the pose, shape (n,); all if not given.
            status: ``tracked``, ``lost`` or ``initialising``; only ``tracked`` has a pose.
        """
        matrix = np.asarray(pose, "<f8").reshape(-1, 4)[:3]
        xy = np.asarray(points, "<f4").reshape(-1, 2)
        flags = np.ones(len(xy), "u1") if inliers is None else np.asarray(inliers, bool)
        spread = b"" if covariance is None else np.asarray(covariance, "<f8").tobytes()
        speed = b"" if velocity is None else np.asarray(velocity, "<f8").tobytes()
        follows = (COVARIANCE if spread else 0) | (VELOCITY if speed else 0)
        head = frame.sequence, frame.stamp, STATUS[status], follows, len(xy), 0
        arrays = matrix.tobytes(), spread, speed, xy.tobytes(), flags.tobytes()
        self._send(POSE, POSE_HEAD.pack(*head), *arrays)

    def lost(self, frame: Frame, points: npt.ArrayLike = ()) -> None:
        """Answer a frame with lost tracking."""
        self.pose(frame, np.eye(4), status="lost", points=points)

    def initialising(self, frame: Frame, points: npt.ArrayLike = ()) -> None:
        """Answer a frame before the first pose."""
        self.pose(frame, np.eye(4), status="initialising", points=points)

    def done(self, frame: Frame) -> None:
        """Answer a frame without a pose, for example a skipped frame."""
        self._send(DONE, DONE_BODY.pack(frame.sequence, frame.stamp))

    def log(self, text: str) -> None:
        """Write a line into the run's log."""
        self._send(LOG, text.encode())

    def close(self, reason: str = "") -> None:
        """Say goodbye and close; arrays of frames stay readable."""
        self._send(BYE, reason.encode())
        self._socket.close()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, _: Any, error: BaseException | None, __: Any) -> None:
        self.close(f"{type(error).__name__}: {error}" if error else "")

    def _send(self, kind: int, *parts: bytes) -> None:
        with self._sending, contextlib.suppress(OSError):  # the run has ended, `receive` says so
            self._socket.sendall(message(kind, *parts))

    def _read(self, head: bytes = b"") -> tuple[int, bytearray]:
        try:
            return read_message(self._socket, head)
        except ProtocolError:
            raise
        except (EOFError, OSError) as error:
            raise ProtocolError(f"the run is gone: {str(error) or 'without BYE'}") from None


def message(kind: int, *parts: bytes) -> bytes:
    """Return a message with its header."""
    return HEADER.pack(sum(map(len, parts)), kind) + b"".join(parts)


def read_message(connection: Any, head: bytes = b"") -> tuple[int, bytearray]:
    """Wait for a message, whose first bytes may be there, and return its type and body.

    Args:
        connection: A socket, or what has its `recv_into`.
        head: The first bytes.

    Raises:
        EOFError: The other side has closed the connection.
        OSError: The same, found out in another way.
        ProtocolError: The message is too long.
    """
    length, kind = HEADER.unpack(head + _exactly(connection, HEADER.size - len(head)))
    if length > LONGEST:
        raise ProtocolError(f"expected at most {LONGEST} bytes, found a message of {length}")
    return kind, _exactly(connection, length)


def _exactly(connection: Any, size: int) -> bytearray:
    data = bytearray(size)
    rest = memoryview(data)
    while rest:
        if not (count := connection.recv_into(rest, 0, socket.MSG_WAITALL)):
            raise EOFError
        rest = rest[count:]
    return data


def text_of(data: bytearray) -> str:
    """Return the text of a message's body; invalid UTF-8 is replaced."""
    return data[:LONGEST_TEXT].decode(errors="replace").rstrip()
