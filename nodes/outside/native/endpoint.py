"""Run's side of the native interface: socket, shared-memory slots, a single program.

Threads and no asyncio: one accepts, one for each connection reads; the caller's thread sends.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import mmap
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events.geometry import inverse
from nodes.outside.native import client as wire
from nodes.outside.native.answers import (
    LinkAnswer,
    LinkError,
    LinkOrder,
    read_done,
    read_order,
    read_pose,
)
from runtime.workers.output import plain_lines
from runtime.workers.shared_memory import anonymous_file

_AT_ONCE = 1 << 16  # size of the read buffer for a program's messages, bytes
GREETING_TIME = 10.0  # real seconds for a connection to send HELLO
GREETING = wire.GREETING.pack(wire.MAGIC, wire.VERSION, 0)

READERS: dict[int, Callable[[bytearray], LinkAnswer | LinkOrder]] = {
    wire.POSE: read_pose,
    wire.DONE: read_done,
    wire.ORDER: read_order,
}

POSE_OF = {number.to_bytes(4, "little"): name for name, number in wire.POSE_OF.items()}

MOST_BEFORE = 64  # most outputs and orders before the answer to a frame
ALIGNMENT = 64
"""Images begin at multiples of this (bytes); a slot has room for the gaps between 16 of them."""


class _Program:
    """Connection of a program, with its unanswered frames."""

    def __init__(self, connection: socket.socket, slots: int) -> None:
        self.connection = connection
        self.sending = threading.Lock()
        self.name = ""
        self.pose_of = ""  # until READY
        self.sequence = 0
        self.owed: dict[int, tuple[int, int]] = {}  # sequence: stamp, slot
        self.before: dict[int, list[LinkAnswer | LinkOrder]] = {}  # of a sequence, until its answer
        self.free = list(range(slots))
        self.origins: dict[int, npt.NDArray[np.float64]] = {}  # inverse first pose, by output
        self.gone = False

    def send(self, kind: int, *parts: bytes) -> bool:
        """Send a message, or return False: the program is gone."""
        with self.sending, contextlib.suppress(OSError):  # the reader notices, too
            self.connection.sendall(wire.message(kind, *parts))
            return True
        return False

    def end(self, kind: int, *parts: bytes) -> None:
        """Send a last message, if possible at once, and disconnect."""
        with contextlib.suppress(OSError):  # it has ended already
            if self.sending.acquire(timeout=0.5):
                try:
                    self.connection.send(wire.message(kind, *parts), socket.MSG_DONTWAIT)
                finally:
                    self.sending.release()
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)


class _Stream(io.BufferedReader):
    """Messages of a socket, read in large pieces."""

    def recv_into(self, buffer: memoryview, _: int, __: int) -> int:
        """Fill the buffer, as `socket.recv_into` does with MSG_WAITALL."""
        return self.readinto(buffer)


class Endpoint:
    """Socket of a run, for a single program at a time.

    All input is checked; a program that sends anything invalid is disconnected. When a program is
    gone, another may connect: `wait` for it again. Its frames are numbered from 0.

    Args:
        gone: Called once when the program is gone or is disconnected, with the reason; in the
            thread that reads. Not after `close`.
        logged: Called with each text for the log, unchecked and unlimited, in the thread that
            reads.
    """

    def __init__(
        self,
        path: Path,  # the socket; at most 107 bytes
        description: Mapping[str, Any],  # sent to the program: see `describe`
        *,
        slots: int,  # unanswered frames of the program, at most
        slot_bytes: int,  # size of a frame's images, of which there are 16 at most
        answered: Callable[[LinkAnswer], None],  # called with each answer, in the thread that reads
        gone: Callable[[str], None],
        logged: Callable[[bytearray], None],
        skips: bool = False,  # whether an answer also frees the slots of all earlier frames
        orders: bool = False,  # whether the program may send orders
    ) -> None:
        self._path = path
        self._description = msgspec.json.encode(description)
        self._orders, self._outputs = orders, len(description["outputs"])
        mounts = [camera["body_from_camera"] for camera in description["cameras"]]
        self._body_from_camera = np.array(mounts[0]) if mounts else None
        self._slots = slots
        self._slot_bytes = slot_bytes + 16 * ALIGNMENT
        self._slot_bytes += -self._slot_bytes % mmap.PAGESIZE
        self._answered, self._gone, self._logged = answered, gone, logged
        self._skips = skips
        self._changed = threading.Condition()
        self._program: _Program | None = None
        self._problem = ""
        self._closed = False
        self._listener: socket.socket | None = None
        self._programs: list[_Program] = []
        self._threads: list[threading.Thread] = []
        self._file = anonymous_file()
        os.ftruncate(self._file, slots * self._slot_bytes)
        self._memory = mmap.mmap(self._file, slots * self._slot_bytes)

    def listen(self) -> None:
        """Create the socket; replace the socket of a dead run.

        Raises:
            LinkError: The path is a living run's, or another file's, or no socket can be made.
        """
        self._listener = _bound(self._path)
        self._start(self._accept)

    def wait(self, seconds: float) -> str:
        """Wait for a program to be ready for frames, and return its name.

        Raises:
            LinkError: None came within `seconds` (real time), or one came and was refused.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ready() or self._problem or self._closed, seconds)
            if program := self._ready():
                return program.name
            found, self._problem = self._problem or f"found none within {seconds:g} s", ""
            if self._program is not None:
                found = f"found {self._program.name}, which did not say READY within {seconds:g} s"
        raise LinkError(f"{self._path}: expected a program, {found}")

    def send_input(self, number: int, arrived: int, rows: npt.NDArray[Any]) -> bool:
        """Send rows of an input, and return whether a program is there.

        Blocks while the program reads nothing and the connection is full.

        Args:
            number: Index in the description's inputs.
            arrived: Time of the run's clock at which the last one came (ns).
            rows: Of the type of the input's kind; see `nodes.outside.native.rows`.

        Raises:
            ValueError: They are longer than a message may be.
        """
        program = self._program
        if (most := (wire.LONGEST - wire.INPUT_HEAD.size) // rows.itemsize) < len(rows):
            raise ValueError(f"expected at most {most} rows in a message, found {len(rows)}")
        head = wire.INPUT_HEAD.pack(number, len(rows), arrived)
        return program is not None and program.send(wire.INPUT, head, rows.tobytes())

    def send_frame(
        self, stamp: int, images: Sequence[tuple[int, str, npt.NDArray[Any]]], wait: bool = True
    ) -> bool:
        """Send a frame; always in the same thread.

        Blocks while all slots are taken, until one is answered, the program is gone, or `close`.

        Args:
            stamp: Time of the exposure (ns).
            images: Index of the camera in the description, kind, and pixels of each.
            wait: Whether to wait for a free slot.

        Returns:
            Whether it was sent: not if there is no program, or no slot without waiting.

        Raises:
            ValueError: An image is not as its kind, or all do not fit into a slot.
        """
        for _, kind, image in images:
            _check(kind, image)
        starts = np.cumsum([0] + [image.nbytes + -image.nbytes % ALIGNMENT for *_, image in images])
        if starts[-1] > self._slot_bytes:
            raise ValueError(f"expected images of {self._slot_bytes} bytes, found {starts[-1]}")
        with self._changed:
            if (program := self._ready()) is None:
                return False
            if wait:
                self._changed.wait_for(lambda: program.free or program.gone or self._closed)
            if not program.free or program.gone or self._closed:
                return False
            slot = program.free.pop(0)
            sequence, program.sequence = program.sequence, program.sequence + 1
            program.owed[sequence] = stamp, slot
        heads = [wire.FRAME_HEAD.pack(sequence, stamp, len(images), 0)]
        for (camera, kind, image), start in zip(images, starts.tolist(), strict=False):
            offset = slot * self._slot_bytes + start
            place = np.ndarray(image.shape, image.dtype, self._memory, offset)
            np.copyto(place, image)
            head = camera, wire.KINDS[kind][0], *image.shape[:2], place.strides[0], 0, offset
            heads.append(wire.IMAGE_HEAD.pack(*head))
        return program.send(wire.FRAME, *heads)

    def close(self) -> None:
        """Say BYE, disconnect, and remove the socket; takes two seconds at most."""
        with self._changed:
            closed, self._closed = self._closed, True
            self._changed.notify_all()
        if closed:
            return
        if self._listener is not None:
            if self._path.is_socket():
                self._path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # wakes the thread that accepts
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
        for program in list(self._programs):
            program.end(wire.BYE)
        deadline = time.monotonic() + 1.0
        for thread in set(self._threads) - {threading.current_thread()}:
            thread.join(max(deadline - time.monotonic(), 0.0))
        os.close(self._file)

    def _ready(self) -> _Program | None:
        return self._program if self._program is not None and self._program.pose_of else None

    def _start(self, run: Callable[[], None]) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(threading.Thread(target=run, name=f"link {self._path}", daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        assert self._listener is not None
        with contextlib.suppress(OSError):  # closed
            while True:
                connection, _ = self._listener.accept()
                self._start(functools.partial(self._serve, connection))

    def _serve(self, connection: socket.socket) -> None:
        program = _Program(connection, self._slots)  # without a name: it only looks who is here
        self._programs.append(program)
        problem, wrong = "its connection has ended", False
        with connection:
            try:
                self._greet(program)
                self._read(program)
            except (LinkError, wire.ProtocolError) as error:
                problem, wrong = str(error), True
            except EOFError as error:
                problem = str(error) or problem
            except OSError:  # no HELLO in time, or the same as EOFError
                pass
            with self._changed:
                program.gone = True
                if self._program is program:
                    self._program = None
                if program.name and not program.pose_of and self._program is None:
                    self._problem = f"found {program.name}: {problem}"
                closed = self._closed
                self._changed.notify_all()
            refused = wrong and not program.pose_of
            head = (wire.REFUSED, GREETING) if refused else (wire.BYE,)
            program.end(*head, problem.encode())
        self._programs.remove(program)
        if program.pose_of and not closed:
            self._gone(f"{program.name}: {problem}")

    def _greet(self, program: _Program) -> None:
        """Read HELLO, take the program if there is no other, and send WELCOME."""
        connection = program.connection
        connection.settimeout(GREETING_TIME)
        kind, body = wire.read_message(connection)
        magic, version, _ = wire.GREETING.unpack_from(body.ljust(wire.GREETING.size, b"\0"))
        if kind != wire.HELLO or magic != wire.MAGIC:
            raise LinkError(f"expected HELLO with {wire.MAGIC!r}, found type {kind} with {magic!r}")
        program.name = _in_a_line(body[wire.GREETING.size :]) or "a program without a name"
        if version != wire.VERSION:
            raise LinkError(f"expected version {wire.VERSION} of the protocol, found {version}")
        with self._changed:
            if self._closed:
                raise LinkError("the run has ended")
            if self._program is not None:
                raise LinkError(f"expected one program, found {self._program.name} connected")
            self._program, self._problem = program, ""
        connection.settimeout(None)
        size = wire.MEMORY.pack(self._slots * self._slot_bytes)
        welcome = wire.message(wire.WELCOME, GREETING, size, self._description)
        socket.send_fds(connection, [welcome[:8]], [self._file])
        connection.sendall(welcome[8:])

    def _read(self, program: _Program) -> None:
        """Read until the program is gone."""
        stream = _Stream(socket.SocketIO(program.connection, "r"), _AT_ONCE)
        while True:
            kind, body = wire.read_message(stream)
            if kind == wire.BYE:
                raise EOFError(f"it said goodbye {_in_a_line(body)}".rstrip())
            if kind == wire.LOG:
                self._logged(body[: wire.LONGEST_TEXT])
            elif kind == wire.READY and not program.pose_of:
                if body[4:] != bytes(4) or bytes(body[:4]) not in POSE_OF:
                    raise LinkError(f"READY.pose_of: expected 0 or 1, found {bytes(body)!r}")
                pose_of = POSE_OF[bytes(body[:4])]
                if pose_of == "camera" and self._body_from_camera is None:
                    raise LinkError("READY.pose_of: expected 1, the body: there is no camera")
                with self._changed:
                    program.pose_of = pose_of
                    self._changed.notify_all()
            elif kind in READERS and program.pose_of:
                self._take(program, READERS[kind](body))
            else:
                expected = "READY once, POSE, DONE, ORDER, LOG or BYE"
                raise LinkError(f"expected {expected}, found type {kind}")

    def _take(self, program: _Program, answer: LinkAnswer | LinkOrder) -> None:
        """Pass an answer on, with what came before it, and free the slot of its frame."""
        further = not isinstance(answer, LinkAnswer) or answer.output > 0
        if isinstance(answer, LinkAnswer):
            if (output := answer.output) > self._outputs:
                raise LinkError(f"POSE.output: expected at most {self._outputs}, found {output}")
            if answer.pose is not None:
                answer = self._of_the_camera(program, answer, answer.pose)
        elif not self._orders:
            raise LinkError("ORDER: expected none, as the program does not fly (pilot = true)")
        with self._changed:
            n = answer.sequence
            if n >= program.sequence:
                raise LinkError(f"sequence: expected below {program.sequence}, found {n}")
            stamp, _ = program.owed.get(n, (answer.stamp, 0))
            if stamp != answer.stamp:
                raise LinkError(f"stamp: expected {stamp} of frame {n}, found {answer.stamp}")
            if further:
                if n not in program.owed:
                    raise LinkError(f"expected it before the answer to frame {n}, found it after")
                before = program.before.setdefault(n, [])
                before.append(answer)
                if len(before) > MOST_BEFORE:
                    raise LinkError(f"expected at most {MOST_BEFORE} outputs before an answer")
                return
            before = program.before.pop(n, [])
            for other in [m for m in program.owed if m == n or (self._skips and m < n)]:
                program.free.append(program.owed.pop(other)[1])
                program.before.pop(other, None)
            self._changed.notify_all()
        assert isinstance(answer, LinkAnswer)
        self._answered(msgspec.structs.replace(answer, before=tuple(before)) if before else answer)

    def _of_the_camera(
        self, program: _Program, answer: LinkAnswer, pose: npt.NDArray[np.float64]
    ) -> LinkAnswer:
        """Return an answer whose pose is the camera's, in the camera at the first pose."""
        lever = np.zeros(3)  # from what the program has the pose of to the camera, in its frame
        if program.pose_of == "body" and self._body_from_camera is not None:
            of_body, pose = pose, pose @ self._body_from_camera
            lever = pose[:3, 3] - of_body[:3, 3]
        origin = program.origins.setdefault(answer.output, inverse(pose))
        turn, covariance, velocity = origin[:3, :3], answer.covariance, answer.velocity
        if covariance is not None:
            moved = np.zeros((6, 6))
            moved[:3, :3] = moved[3:, 3:] = turn
            moved[:3, 3:] = -turn @ np.cross(np.eye(3), lever)  # a rotation moves the camera
            covariance = moved @ covariance @ moved.T
        return msgspec.structs.replace(
            answer,
            pose=origin @ pose,
            covariance=covariance,
            velocity=None if velocity is None else turn @ velocity,
        )


def _in_a_line(text: bytearray) -> str:
    return " ".join(plain_lines(text[: wire.LONGEST_TEXT])).rstrip()


def _bound(path: Path) -> socket.socket:
    """Return a socket listening at `path`, open to this user only."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket() and not _alive(path):
            path.unlink()
        listener.bind(str(path))
        path.chmod(0o600)
        listener.listen(4)
    except OSError as error:  # a run or a file is there, the folder is missing, it is too long
        listener.close()
        problem = f"expected a place for a socket, found: {error.strerror or error}"
        raise LinkError(f"{path}: {problem}") from None
    return listener


def _alive(path: Path) -> bool:
    """Return whether anybody listens at a socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        return probe.connect_ex(str(path)) != errno.ECONNREFUSED


def _check(kind: str, image: npt.NDArray[Any]) -> None:
    """Raise a `ValueError` where an image is not as its kind."""
    if kind not in wire.KINDS:
        raise ValueError(f"expected one of {', '.join(wire.KINDS)}, found {kind!r}")
    _, dtype, pixel = wire.KINDS[kind]
    if image.dtype != dtype or image.shape[2:] != pixel or image.ndim != 2 + len(pixel):
        raise ValueError(
            f"{kind}: expected {dtype} of shape (height, width{', 3' * bool(pixel)}), "
            f"found {image.dtype} of {image.shape}"
        )
