"""Run's side of the native interface: socket, shared-memory slots, a single program.

It turns bytes into messages and back. Which frames are owed an answer is not known here, only what
memory a program may still read. One thread reads all connections; the caller's thread sends.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.outside.native import client as wire
from nodes.outside.native.answers import (
    CameraPoses,
    LinkAnswer,
    LinkError,
    LinkOrder,
    LinkTrajectory,
    read_done,
    read_order,
    read_pose,
    read_trajectory,
)
from runtime.workers.output import plain_lines
from runtime.workers.shared_memory import anonymous_file

_AT_ONCE = 1 << 16  # bytes of a single read
GREETING_TIME = 10.0  # real seconds for a connection to send HELLO
_LOOK = 0.5  # real seconds between two checks of that time
GREETING = wire.GREETING.pack(wire.MAGIC, wire.VERSION, 0)

READERS: dict[int, Callable[[bytearray], LinkAnswer | LinkOrder]] = {
    wire.POSE: read_pose,
    wire.DONE: read_done,
    wire.ORDER: read_order,
}

POSE_OF = {number: name for name, number in wire.POSE_OF.items()}

MOST_BEFORE = 64  # most outputs and orders before the answer to a frame
ALIGNMENT = 64
"""Images begin at multiples of this (bytes); a slot has room for the gaps between 16 of them."""


class _Lent(NamedTuple):
    """Slot lent to a program, for the images of a frame."""

    stamp: int  # of the frame (ns)
    slot: int
    before: list[LinkAnswer | LinkOrder]  # what has come of the frame before its answer


class _Program:
    """Connection of a program."""

    def __init__(self, connection: socket.socket, slots: int) -> None:
        self.connection = connection
        self.greeted_by = time.monotonic() + GREETING_TIME
        self.sending = threading.Lock()
        self.name = ""  # until HELLO
        self.poses: CameraPoses | None = None  # until READY
        self.sequence = 0
        self.lent: dict[int, _Lent] = {}  # by sequence
        self.free = list(range(slots))
        self.gone = False
        self.promised = self.finished = False  # a trajectory; whether it knows that the run ended
        self.trajectory: LinkTrajectory | None = None
        self.end_reason = ""
        self._received = bytearray()

    def receive(self) -> Iterator[tuple[int, bytearray]]:
        """Yield type and body of the messages that are here.

        Raises:
            EOFError: The program has closed the connection.
            OSError: The same, found out in another way.
            ProtocolError: A message is too long.
        """
        data = self.connection.recv(_AT_ONCE, socket.MSG_DONTWAIT)
        if not data:
            raise EOFError
        received, start = self._received, 0
        received += data
        while len(received) >= start + wire.HEADER.size:
            length, kind = wire.read_header(received, start)
            body = start + wire.HEADER.size
            if len(received) < body + length:
                break
            start = body + length
            yield kind, received[body:start]
        del received[:start]

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
        self.disconnect()

    def disconnect(self) -> None:
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)


class Endpoint:
    """Socket of a run, for a single program at a time.

    All input is checked; a program that sends anything invalid is disconnected. When a program is
    gone, another may connect. Its frames are numbered from 0.

    All functions given are called in the thread that reads.

    Args:
        gone: Called once when the program is gone or is disconnected, with the reason. Not after
            `close`, nor of a program whose trajectory `finish` awaits.
        logged: Called with each text for the log, unchecked and unlimited.
    """

    def __init__(
        self,
        path: Path,  # the socket; at most 107 bytes
        description: Mapping[str, Any],  # sent to the program: see `describe`
        *,
        slots: int,  # unanswered frames of the program, at most
        slot_bytes: int,  # size of a frame's images, of which there are 16 at most
        answered: Callable[[LinkAnswer], None],  # called with each answer
        gone: Callable[[str], None],
        logged: Callable[[bytearray], None],
        ready: Callable[[], None] = lambda: None,  # called when frames may be sent
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
        self._answered, self._gone, self._logged, self._on_ready = answered, gone, logged, ready
        self._changed = threading.Condition()
        self._program: _Program | None = None
        self._problem = ""
        self._closed = False
        self._listener: socket.socket | None = None
        self._programs: list[_Program] = []  # all connections
        self._selector = selectors.DefaultSelector()
        self._reader = threading.Thread(target=self._read, name=f"link {path}", daemon=True)
        self._file = anonymous_file()
        os.ftruncate(self._file, slots * self._slot_bytes)
        self._memory = mmap.mmap(self._file, slots * self._slot_bytes)

    def listen(self) -> None:
        """Create the socket; replace the socket of a dead run.

        Raises:
            LinkError: The path is a living run's, or another file's, or no socket can be made.
        """
        self._listener = _bound(self._path)
        self._reader.start()

    def wait(self, seconds: float) -> str:
        """Wait for a program to be ready for frames, and return its name.

        Raises:
            LinkError: None came within `seconds` (real time), or one came and was refused.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ready() or self._problem or self._closed, seconds)
            if program := self._ready():
                return program.name
            problem, self._problem = self._problem or f"found none within {seconds:g} s", ""
            if self._program is not None:
                name = self._program.name
                problem = f"found {name}, which did not say READY within {seconds:g} s"
        raise LinkError(f"{self._path}: expected a program, {problem}")

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
            program.lent[sequence] = _Lent(stamp, slot, [])
        heads = [wire.FRAME_HEAD.pack(sequence, stamp, len(images), 0)]
        for (camera, kind, image), start in zip(images, starts.tolist(), strict=False):
            offset = slot * self._slot_bytes + start
            place = np.ndarray(image.shape, image.dtype, self._memory, offset)
            np.copyto(place, image)
            head = camera, wire.KINDS[kind][0], *image.shape[:2], place.strides[0], 0, offset
            heads.append(wire.IMAGE_HEAD.pack(*head))
        return program.send(wire.FRAME, *heads)

    def release(self, stamp: int) -> None:
        """Free the slots of all frames before a stamp (ns): the program has skipped them."""
        with self._changed:
            if (program := self._program) is not None:
                for sequence in [n for n, lent in program.lent.items() if lent.stamp < stamp]:
                    program.free.append(program.lent.pop(sequence).slot)
                self._changed.notify_all()

    @property
    def promised(self) -> bool:
        """Return whether a program is there that promised its final trajectory."""
        return self._program is not None and self._program.promised

    def finish(self, seconds: float) -> LinkTrajectory:
        """Send BYE, and wait at most `seconds` (real time) for the trajectory `promised`.

        Raises:
            LinkError: It did not come.
        """
        if (program := self._program) is None:
            raise LinkError("expected a program with its trajectory, found none")
        program.finished = True
        program.send(wire.BYE)
        with self._changed:
            self._changed.wait_for(
                lambda: program.trajectory or program.gone or self._closed, seconds
            )
            if program.trajectory is None:
                found = program.end_reason or f"none in the {seconds:.2g} s left of grace"
                raise LinkError(f"{program.name}: expected its trajectory, found {found}")
            return program.trajectory

    def close(self) -> None:
        """Send BYE, disconnect, and remove the socket; takes two seconds at most."""
        with self._changed:
            closed, self._closed = self._closed, True
            self._changed.notify_all()
        if closed:
            return
        if self._listener is not None:
            if self._path.is_socket():
                self._path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # wakes the reader, which closes it
                self._listener.shutdown(socket.SHUT_RDWR)
            for program in list(self._programs):
                if program.finished:
                    program.disconnect()
                else:
                    program.end(wire.BYE)
            if self._reader is not threading.current_thread():
                self._reader.join(1.0)
        os.close(self._file)

    def _ready(self) -> _Program | None:
        return self._program if self._program is not None and self._program.poses else None

    # In the thread that reads.

    def _read(self) -> None:
        """Serve all connections until `close` has ended them."""
        assert self._listener is not None
        with self._listener, self._selector:
            self._selector.register(self._listener, selectors.EVENT_READ)
            while self._selector.get_map():
                for key, _ in self._selector.select(_LOOK):
                    if key.data is None:
                        self._accept(self._listener)
                    else:
                        self._serve(key.data)
                for program in [program for program in self._programs if not program.name]:
                    if time.monotonic() > program.greeted_by:
                        self._drop(program, "its connection has ended")

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, _ = listener.accept()
        except OSError:  # closed
            self._selector.unregister(listener)
            return
        program = _Program(connection, self._slots)  # without a name: it only looks who is here
        self._programs.append(program)
        self._selector.register(connection, selectors.EVENT_READ, program)

    def _serve(self, program: _Program) -> None:
        """Handle the messages that are here, or the end of the connection."""
        try:
            for kind, body in program.receive():
                if program.name:
                    self._handle(program, kind, body)
                else:
                    self._greet(program, kind, body)
        except (LinkError, wire.ProtocolError) as error:
            self._drop(program, str(error), wrong=True)
        except EOFError as error:
            self._drop(program, str(error) or "its connection has ended")
        except OSError:
            self._drop(program, "its connection has ended")

    def _drop(self, program: _Program, reason: str, wrong: bool = False) -> None:
        """End a connection; `wrong` if the program broke the protocol."""
        with self._changed:
            program.gone, program.end_reason = True, reason
            if self._program is program:
                self._program = None
            if program.name and not program.poses and self._program is None:
                self._problem = f"found {program.name}: {reason}"
            closed = self._closed
            self._changed.notify_all()
        if wrong and program.finished:
            self._logged(bytearray(f"after the run: {reason}", "utf-8"))
        refused = wrong and not program.poses
        head = (wire.REFUSED, GREETING) if refused else (wire.BYE,)
        self._selector.unregister(program.connection)
        program.end(*head, reason.encode())
        program.connection.close()
        self._programs.remove(program)
        if program.poses and not closed and not program.finished:
            self._gone(f"{program.name}: {reason}")

    def _greet(self, program: _Program, kind: int, body: bytearray) -> None:
        """Accept the program that says HELLO if there is no other, and send WELCOME."""
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
        size = wire.MEMORY.pack(self._slots * self._slot_bytes)
        welcome = wire.message(wire.WELCOME, GREETING, size, self._description)
        socket.send_fds(program.connection, [welcome[:8]], [self._file])
        program.connection.sendall(welcome[8:])

    def _handle(self, program: _Program, kind: int, body: bytearray) -> None:
        """Handle a message after HELLO."""
        if kind == wire.BYE:
            raise EOFError(f"it said goodbye {_in_a_line(body)}".rstrip())
        if kind == wire.LOG:
            self._logged(body[: wire.LONGEST_TEXT])
        elif kind == wire.READY and not program.poses:
            if len(body) != wire.READY_BODY.size:
                raise LinkError(f"READY: expected {wire.READY_BODY.size} bytes, found {len(body)}")
            number, promised = wire.READY_BODY.unpack(body)
            if number not in POSE_OF:
                raise LinkError(f"READY.pose_of: expected 0 or 1, found {number}")
            if promised > 1:
                raise LinkError(f"READY.trajectory: expected 0 or 1, found {promised}")
            pose_of, program.promised = POSE_OF[number], bool(promised)
            if pose_of == "camera" and self._body_from_camera is None:
                raise LinkError("READY.pose_of: expected 1, the body: there is no camera")
            with self._changed:
                program.poses = CameraPoses(self._body_from_camera if pose_of == "body" else None)
                self._changed.notify_all()
            self._on_ready()
        elif kind == wire.TRAJECTORY and program.poses and program.promised:
            if not program.finished:
                raise LinkError("TRAJECTORY: expected it after the run's BYE, found it before")
            if program.trajectory is not None:
                raise LinkError("TRAJECTORY: expected one, found a second")
            trajectory = program.poses.of_trajectory(read_trajectory(body))
            with self._changed:
                program.trajectory = trajectory
                self._changed.notify_all()
        elif kind in READERS and program.poses:
            self._record(program, program.poses, READERS[kind](body))
        else:
            expected = "READY once, POSE, DONE, ORDER, a promised TRAJECTORY, LOG or BYE"
            raise LinkError(f"expected {expected}, found type {kind}")

    def _record(
        self, program: _Program, poses: CameraPoses, message: LinkAnswer | LinkOrder
    ) -> None:
        """Report an answer with what came before it, and free the slot of its frame."""
        if isinstance(message, LinkAnswer):
            if (output := message.output) > self._outputs:
                raise LinkError(f"POSE.output: expected at most {self._outputs}, found {output}")
            message = poses.of(message)
        elif not self._orders:
            raise LinkError("ORDER: expected none, as the program does not fly (pilot = true)")
        n = message.sequence
        with self._changed:
            if n >= program.sequence:
                raise LinkError(f"sequence: expected below {program.sequence}, found {n}")
            lent = program.lent.get(n)
            if lent is not None and lent.stamp != message.stamp:
                raise LinkError(f"stamp: expected {lent.stamp} of frame {n}, found {message.stamp}")
            if isinstance(message, LinkOrder) or message.output > 0:
                if lent is None:
                    raise LinkError(f"expected it before the answer to frame {n}, found it after")
                lent.before.append(message)
                if len(lent.before) > MOST_BEFORE:
                    raise LinkError(f"expected at most {MOST_BEFORE} outputs before an answer")
                return
            if lent is not None:
                del program.lent[n]
                program.free.append(lent.slot)
                self._changed.notify_all()
        before = tuple(lent.before) if lent is not None else ()
        self._answered(msgspec.structs.replace(message, before=before) if before else message)


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
