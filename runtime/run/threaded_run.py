"""A run in a thread of its own, beside a caller whose own loop goes on: a notebook, a script."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Iterator

from runtime.config.model import Config
from runtime.run.execute import Watch, execute
from runtime.run.results import Folder
from runtime.run.supervisor import Supervisor


class ThreadedRun(threading.Thread):
    """Thread of one run, for a caller whose own loop goes on; the arguments are those of `execute`.

    A notebook has a loop that runs already, and a script may start several runs at a time.
    """

    def __init__(
        self, config: Config, out: Folder, handlers: list[logging.Handler], watch: Watch
    ) -> None:
        super().__init__(name=f"run {config.run.name}", daemon=True)
        self._config = config
        self._out = out
        self._handlers = handlers
        self._watch = watch
        self._end: Callable[[], object] | None = None
        self._interrupted = False
        self._error: BaseException | None = None
        self._over = threading.Event()

    def run(self) -> None:
        """Run to the end; called by the thread."""
        try:
            execute(self._config, self._out, handlers=self._handlers, watch=self._watching)
        except BaseException as error:
            self._error = error
        finally:
            self._over.set()

    @contextlib.contextmanager
    def _watching(self, supervisor: Supervisor) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        self._end = lambda: loop.call_soon_threadsafe(supervisor.stop, "Ctrl-C")
        if self._interrupted:
            self._end()
        with self._watch(supervisor):
            yield

    def wait(self) -> None:
        """Wait for the end; raise what went wrong. Ctrl-C ends the run, a second is raised."""
        try:
            self._over.wait()
        except BaseException:
            self._interrupted = True
            if self._end is not None:
                with contextlib.suppress(RuntimeError):  # the loop is closed
                    self._end()
            self._over.wait()
            raise
        if self._error is not None:
            raise self._error
