"""Processes of a worker that are threads here: what they do and when they end is up to a test."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
from typing import Any, ClassVar

from runtime.workers.output import PortableError
from runtime.workers.shared_memory import SharedPipe


class Wall:
    """Real time, as a worker reads it; it passes when a test says so."""

    def __init__(self) -> None:
        self.now = 1000.0
        self._looked = threading.Semaphore(0)

    def monotonic(self) -> float:
        self._looked.release()
        return self.now

    def pass_by(self, seconds: float, looks: int = 4) -> None:
        """Let time pass, and wait until it has been looked at so often since."""
        self.now += seconds
        while self._looked.acquire(blocking=False):
            pass
        for _ in range(looks):
            assert self._looked.acquire(timeout=10)


class Exits(BaseException):
    """Raised by a method: the process ends with this code, without an answer."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class PretendedProcess:
    """Stands for `subprocess.Popen`: a thread that makes the object and answers its calls."""

    all: ClassVar[list[PretendedProcess]] = []
    first_pid: ClassVar[int] = 1 << 30  # beyond those of any system

    def __init__(
        self, command: list[str], *, pass_fds: tuple[int, ...], env: dict[str, str], **_: Any
    ) -> None:
        self.command, self.env = command, env
        self.pid = self.first_pid + len(self.all)
        self.code: int | None = None
        self.kills: list[tuple[int, bool]] = []  # signals, and whether it was over before
        self.conditions: Any = None
        self.target: Any = None
        self._over = threading.Event()
        read, self._output = os.pipe()
        self.stdout = os.fdopen(read, "rb", buffering=0)
        connection, in_fd, out_fd = map(os.dup, pass_fds)
        self.pipe = SharedPipe(socket.socket(fileno=connection), out_fd, in_fd)
        self.all.append(self)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def poll(self) -> int | None:
        return self.code

    def wait(self, timeout: float | None = None) -> int:
        if not self._over.wait(timeout):
            raise subprocess.TimeoutExpired(self.command, timeout or 0.0)
        assert self.code is not None
        return self.code

    def print(self, text: str) -> None:
        os.write(self._output, text.encode())

    def exit(self, code: int, *, leaving_a_fork: bool = False) -> None:
        """End; a fork would hold the connection and the output open."""
        if self.code is None:
            self.code = code
            self._over.set()
            if not leaving_a_fork:
                self.pipe.shut_down()
                self._close_output()

    def dispose(self) -> None:
        """Close what it has open, the fork's, too."""
        self.pipe.shut_down()
        self._thread.join()
        self.pipe.close()
        self._close_output()

    def _close_output(self) -> None:
        if self._output >= 0:
            output, self._output = self._output, -1
            os.close(output)

    def kill(self, number: int) -> None:
        self.kills.append((number, self.code is not None))
        self.exit(-number)

    def _serve(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            self.conditions = self.pipe.receive()
            while True:
                message = self.pipe.receive()
                try:
                    answer = self._answer(*message)
                except Exits as end:
                    self.exit(end.code)
                    return
                self.pipe.send(answer)
        if not getattr(self.target, "stays", False):
            self.exit(0)

    def _answer(self, what: Any, args: tuple[Any, ...], *options: Any) -> tuple[Any, ...]:
        making = not options
        try:
            if making:
                result, self.target = None, what(*args)
            else:
                result = getattr(self.target, what)(*args, **options[0])
        except Exception as error:
            return False, PortableError.of(error, "plant.py:7 in grow"), 5_000 * (not making), 3_000
        return True, result, 5_000 * (not making), 3_000


def kill_group(pid: int, number: int) -> None:
    """Stand for `os.killpg`."""
    process = PretendedProcess.all[pid - PretendedProcess.first_pid]
    process.kill(number)


class Tree:
    """An object in such a process; its methods see the process from inside."""

    stays: ClassVar[bool] = False  # whether its process goes on without a connection

    def __init__(self, trouble: str = "") -> None:
        if trouble:
            raise LookupError(trouble)
        self._process = PretendedProcess.all[-1]

    def echo(self, value: Any) -> Any:
        return value

    def fail(self) -> None:
        raise LookupError("no water")

    def misleading(self) -> Any:
        return Misleading()

    def fall(self, code: int, text: str) -> None:
        self._process.print(text)
        raise Exits(code)

    def wait(self, event: int) -> int:
        assert EVENTS[event].wait(10)
        return event


class StubbornTree(Tree):
    stays = True


class Misleading:
    """Cannot be made again by who receives it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (raise_lookup, ())


def raise_lookup() -> None:
    raise LookupError("not here")


EVENTS = [threading.Event() for _ in range(4)]
SIGKILL = int(signal.SIGKILL)
