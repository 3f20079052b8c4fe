"""The native interface's client: feeds a Python program with a run's images and measurements.

This file may be copied; it needs numpy, and nothing else of the project::

    with Link("my_slam") as link:               # connects to the socket that $VISNAV_SOCKET names
        camera = link.description["cameras"][0]["info"]
        slam = MySlam(camera["fx"], camera["fy"], camera["cx"], camera["cy"])
        link.ready()
        for frame in link:                      # until the run ends
            pose = slam.track(frame.image("rgb8"), frame.image("depth32f"), frame.rows("imu"))
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
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

MAGIC, VERSION = b"VISNAVLK", 2
HELLO, WELCOME, REFUSED, READY, BYE = 1, 2, 3, 4, 5
INPUT, FRAME = 16, 17
POSE, DONE, LOG, ORDER, TRAJECTORY = 32, 33, 34, 35, 36

HEADER = struct.Struct("<II")  # of each message: length of its body (bytes), type
GREETING = struct.Struct("<8sII")  # begins HELLO, WELCOME and REFUSED: magic, version, 0
MEMORY = struct.Struct("<Q")  # follows in WELCOME: size of the shared memory (bytes)
INPUT_HEAD = struct.Struct("<IIq")  # input, number of rows, time at which they came (ns)
FRAME_HEAD = struct.Struct("<QqII")  # sequence, stamp (ns), number of images, 0
IMAGE_HEAD = struct.Struct("<IIIIIIQ")  # camera, kind, height, width, stride (bytes), 0, offset
POSE_HEAD = struct.Struct("<QqIIII")  # sequence, stamp, status, follows, points, output
DONE_BODY = struct.Struct("<Qq")  # sequence, stamp (ns)
ORDER_BODY = struct.Struct("<QqII8d")  # sequence, stamp, order, axes, numbers
READY_BODY = struct.Struct("<II")  # whose poses, whether a trajectory comes after the run's BYE
LONGEST, LONGEST_TEXT = 1 << 24, 4096  # bytes of a body; of a name, a reason, a line of the log

_FIELDS: dict[str, list[tuple[Any, ...]]] = {
    "imu": [("angular_velocity", "<f8", 3), ("linear_acceleration", "<f8", 3)],
    "fluid_pressure": [("fluid_pressure", "<f8"), ("variance", "<f8")],
    "magnetic_field": [("magnetic_field", "<f8", 3)],
    "nav_sat_fix": [
        ("latitude", "<f8"),
        ("longitude", "<f8"),
        ("altitude", "<f8"),
        ("velocity", "<f8", 3),
        ("position_covariance", "<f8", (3, 3)),
        ("status", "<i8"),
    ],
    "range": [("range", "<f8"), ("min_range", "<f8"), ("max_range", "<f8")],
    "lidar_scan": [("point", "<f4", 3), ("intensity", "<f4"), ("ring", "<u8")],
    "pose_estimate": [
        ("frame", "<u8"),
        ("pose", "<f8", (3, 4)),
        ("velocity", "<f8", 3),
        ("covariance", "<f8", (6, 6)),
    ],
}
RECORDS = {kind: np.dtype([("stamp", "<i8"), *rest]) for kind, rest in _FIELDS.items()}
"""Rows of each kind of input: a stamp (ns), and the fields of the event of that name.

Units and axes are those of the events. A point's stamp is that of its ray. Poses are of the body
(FRD) in ``map`` or a frame of the estimator, numbered by `frame` from 0; NaN in all of a pose says
that tracking is lost, in velocity or covariance that it is not known.
"""

KINDS: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {
    "mono8": (1, np.dtype("u1"), ()),
    "rgb8": (2, np.dtype("u1"), (3,)),
    "depth32f": (3, np.dtype("<f4"), ()),
    "segmentation32i": (4, np.dtype("<i4"), ()),
}  # kinds of image: number, type of a value, values of a pixel

STAMPED_POSE = np.dtype([("stamp", "<i8"), ("pose", "<f8", (3, 4))])
"""A pose of a trajectory: of a stamp (ns), metres."""

ORDERS = {"takeoff": 0, "land": 1, "position": 2, "velocity": 3}
AXES = {"map": 0, "heading": 1}
STATUS = {"tracked": 0, "lost": 1, "initialising": 2}
POSE_OF = {"camera": 0, "body": 1}
COVARIANCE, VELOCITY = 1, 2  # what follows a pose


class ProtocolError(ConnectionError):
    """The run refuses this program, has gone without a word, or does not keep to the protocol."""


class LinkImage(NamedTuple):
    """An image in shared memory: valid until its frame has been answered, read-only."""

    camera: int  # index in the description's cameras
    kind: str  # one of `KINDS`
    # Shape (height, width), or (height, width, 3) for rgb8; depth32f is metres along z, inf where
    # there is none.
    data: npt.NDArray[Any]


class LinkInput(NamedTuple):
    """Measurements of a sensor in a row, a whole scan, or estimates of another node."""

    name: str  # one of the description's inputs
    arrived: int  # time of the run's clock at which the last one came (ns): its stamp and latency
    rows: npt.NDArray[Any]  # one of `RECORDS`


class Frame(NamedTuple):
    """Images of an exposure, or another occasion for an answer, and what came before."""

    sequence: int  # 0, 1, 2, …
    stamp: int  # time of the exposure, or of the measurement that asks for an answer (ns)
    images: tuple[LinkImage, ...]  # all images
    inputs: tuple[LinkInput, ...]  # what came since the frame before, in the order in which it came
    kinds: Mapping[str, str]  # kind of each input, by name
    records: Mapping[str, np.dtype[Any]] = RECORDS  # rows of each kind

    def rows(self, name: str) -> npt.NDArray[Any]:
        """Return what came of an input since the frame before; raise `LookupError` if unknown."""
        if name not in self.kinds:
            raise LookupError(f"expected one of {', '.join(self.kinds) or 'none'}, found {name!r}")
        none = np.empty(0, self.records[self.kinds[name]])
        return np.concatenate([none, *(part.rows for part in self.inputs if part.name == name)])

    def image(self, kind: str, camera: int = 0) -> npt.NDArray[Any]:
        """Return a camera's image of a kind; raise `LookupError` if there is none."""
        for image in self.images:
            if (image.camera, image.kind) == (camera, kind):
                return image.data
        known = ", ".join(f"{image.kind} of {image.camera}" for image in self.images)
        raise LookupError(f"expected an image {kind} of camera {camera}, found {known or 'none'}")


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
        self._promised = False
        self._kinds: dict[str, str] = {}
        self._records = RECORDS
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with contextlib.ExitStack() as unless_joined:
            unless_joined.callback(self._socket.close)
            try:
                self._socket.connect(path)
            except OSError as error:
                raise ProtocolError(f"expected the socket of a run at {path!r}: {error}") from None
            self._send(HELLO, GREETING.pack(MAGIC, VERSION, 0) + name.encode())
            self.description = self._welcome()
            self._kinds = {row["name"]: row["kind"] for row in self.description["inputs"]}
            self._records = RECORDS | {
                row["kind"]: np.dtype([("stamp", "<i8"), *map(_column, row["row"])])
                for row in self.description["inputs"]
                if "row" in row  # of a kind that is not part of the protocol
            }
            unless_joined.pop_all()

    description: dict[str, Any]
    """Cameras, inputs, outputs and clock of the run."""

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

    def ready(self, pose_of: str = "camera", trajectory: bool = False) -> None:
        """Send READY, and what will be sent.

        Args:
            pose_of: Whose poses: of the optical ``camera`` 0, or the ``body``.
            trajectory: Whether a trajectory comes when the run has ended; see `trajectory`.
        """
        self._promised = trajectory
        self._send(READY, READY_BODY.pack(POSE_OF[pose_of], trajectory))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames until the run ends, each with its inputs."""
        inputs: list[LinkInput] = []
        while (received := self.receive()) is not None:
            if isinstance(received, Frame):
                yield received._replace(inputs=tuple(inputs))
                inputs.clear()
            else:
                inputs.append(received)

    def receive(self) -> Frame | LinkInput | None:
        """Wait for a frame (without its inputs) or an input; return `None` at the end of the run.

        Raises:
            ProtocolError: The run has gone without a word, or does not keep to the protocol.
        """
        kind, body = self._read()
        if kind == BYE and body:
            raise ProtocolError(f"the run has ended the connection: {text_of(body)}")
        if kind == BYE:
            return None
        if kind not in (INPUT, FRAME):
            raise ProtocolError(f"expected INPUT, FRAME or BYE, found type {kind}")
        try:
            return self._frame(body) if kind == FRAME else self._input(body)
        except (struct.error, ValueError, IndexError) as error:
            expected = "a frame" if kind == FRAME else "an input"
            raise ProtocolError(f"expected {expected}, found {error}") from None

    def _input(self, body: bytearray) -> LinkInput:
        number, count, arrived = INPUT_HEAD.unpack_from(body)
        name, kind = list(self._kinds.items())[number]
        rows = np.frombuffer(body, self._records[kind], offset=INPUT_HEAD.size)
        if len(rows) != count:
            raise ValueError(f"{len(rows)} rows in place of {count}")
        return LinkInput(name, arrived, rows)

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
        return Frame(sequence, stamp, tuple(images), (), self._kinds, self._records)

    def pose(
        self,
        frame: Frame,
        pose: npt.ArrayLike,
        *,
        covariance: npt.ArrayLike | None = None,
        velocity: npt.ArrayLike | None = None,  # in that frame, metres per second, shape (3,)
        points: npt.ArrayLike = (),
        inliers: npt.ArrayLike | None = None,
        status: str = "tracked",
        output: str = "",
    ) -> None:
        """Answer a frame with a pose.

        Args:
            pose: Transform from the optical camera (or the body: see `ready`) to a frame that stays
                the same, metres, shape (4, 4) or (3, 4).
            covariance: Of the pose's error: a shift along x, y, z and a rotation about them, all in
                that frame, m², m rad and rad², shape (6, 6).
            points: Features that were tracked: column and row, pixels, shape (n, 2).
            inliers: Which of them agree with the pose, shape (n,); all if not given.
            status: ``tracked``, ``lost`` or ``initialising``; only ``tracked`` has a pose.
            output: One of the description's further outputs, before the answer itself; each has a
                frame of its own. Empty: this is the answer.
        """
        matrix = np.asarray(pose, "<f8").reshape(-1, 4)[:3]
        xy = np.asarray(points, "<f4").reshape(-1, 2)
        flags = np.ones(len(xy), "u1") if inliers is None else np.asarray(inliers, bool)
        spread = b"" if covariance is None else np.asarray(covariance, "<f8").tobytes()
        speed = b"" if velocity is None else np.asarray(velocity, "<f8").tobytes()
        follows = (COVARIANCE if spread else 0) | (VELOCITY if speed else 0)
        number = self.description["outputs"].index(output) + 1 if output else 0
        head = frame.sequence, frame.stamp, STATUS[status], follows, len(xy), number
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

    def order(
        self,
        frame: Frame,
        order: str,
        *,
        position: npt.ArrayLike = (0.0, 0.0, 0.0),  # metres in ``map``: north, east, down
        velocity: npt.ArrayLike = (0.0, 0.0, 0.0),  # metres per second along `axes`
        yaw: float = 0.0,  # of a position: radians, clockwise from north seen from above
        yaw_rate: float = 0.0,  # radians per second
        axes: str = "map",
    ) -> None:
        """Fly the vehicle, before the answer to a frame and from when that counts.

        Args:
            order: ``takeoff`` (to the height -z of `position` above the ground), ``land``,
                ``position`` (with a velocity along a path) or ``velocity``.
            axes: Of a velocity: ``map``, or ``heading`` (x ahead, y to the right, z down).
        """
        numbers = *np.asarray(position, float), *np.asarray(velocity, float), yaw, yaw_rate
        head = frame.sequence, frame.stamp, ORDERS[order], AXES[axes]
        self._send(ORDER, ORDER_BODY.pack(*head, *numbers))

    def trajectory(self, stamps: npt.ArrayLike, poses: npt.ArrayLike) -> None:
        """Give the final trajectory, after the last frame, if `ready` promised it.

        Args:
            stamps: Those of frames (ns), strictly rising, shape (n,).
            poses: As those of `pose`, in the same frame, shape (n, 4, 4) or (n, 3, 4).

        Raises:
            ProtocolError: `ready` has not promised it.
        """
        if not self._promised:
            raise ProtocolError("expected ready(trajectory=True) before a trajectory, found none")
        matrices = np.asarray(poses, "<f8")
        rows = np.empty(len(matrices), STAMPED_POSE)
        rows["stamp"] = stamps
        if len(rows):
            rows["pose"] = matrices[:, :3]
        self._send(TRAJECTORY, rows.tobytes())

    def log(self, text: str) -> None:
        """Write a line into the run's log."""
        self._send(LOG, text.encode())

    def close(self, reason: str = "") -> None:
        """Send BYE and close; arrays of frames stay readable."""
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


def _column(described: list[Any]) -> tuple[Any, ...]:
    """Return a column of a record: its name, its type, and the shape of its values if any."""
    name, type_, *shape = described
    return (name, type_, *map(tuple, shape))


def message(kind: int, *parts: bytes) -> bytes:
    """Return a message with its header."""
    return HEADER.pack(sum(map(len, parts)), kind) + b"".join(parts)


def read_message(
    connection: socket.socket,
    head: bytes = b"",  # the first bytes
) -> tuple[int, bytearray]:
    """Wait for a message, whose first bytes may be there, and return its type and body.

    Raises:
        EOFError: The other side has closed the connection.
        OSError: The same, found out in another way.
        ProtocolError: The message is too long.
    """
    length, kind = read_header(head + _exactly(connection, HEADER.size - len(head)))
    return kind, _exactly(connection, length)


def read_header(data: bytes | bytearray, at: int = 0) -> tuple[int, int]:
    """Return length of the body and type of the message that begins at an offset.

    Raises:
        ProtocolError: The message is too long.
    """
    length, kind = HEADER.unpack_from(data, at)
    if length > LONGEST:
        raise ProtocolError(f"expected at most {LONGEST} bytes, found a message of {length}")
    return length, kind


def _exactly(connection: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    remaining = memoryview(data)
    while remaining:
        if not (count := connection.recv_into(remaining, 0, socket.MSG_WAITALL)):
            raise EOFError
        remaining = remaining[count:]
    return data


def text_of(data: bytearray) -> str:
    """Return the text of a message's body; invalid UTF-8 is replaced."""
    return data[:LONGEST_TEXT].decode(errors="replace").rstrip()
