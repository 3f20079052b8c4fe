"""Errors raised on purpose by this package, and whose fault each is.

    VisnavError
    ├── ConfigError            the file or the command line: expected, found, where
    ├── DeclarationError       a node's class: a port, handler or tick is declared wrongly
    ├── MissingDependencyError something to install; the message says how
    ├── UnsupportedInterpreterError  this Python cannot do what the file asks for
    ├── NodeError              a node failed while running
    │   ├── FatalError         …because it said so itself (`log.fatal`)
    │   ├── RefusedError       …because it refused what another node announced
    │   └── NodeTimeoutError   …because a step took longer than its limit
    ├── ChannelError
    │   ├── ChannelFullError   the receiver fell behind further than it allowed
    │   ├── ChannelClosedError you (or the end of the run) closed it
    │   ├── ChannelBusyError   two coroutines wait on one input
    │   ├── ChannelTypeError   something else was sent than the output declares
    │   ├── ChannelThreadError `send` was called in another thread than the loop's
    │   └── AmbiguousSourceError  an input that matches stamps receives two sources
    ├── CommandError           a run cannot do what its monitor asked it to
    ├── ResultsError           a run's folder is not ours, or cannot be written
    ├── UncheckableError       what a node will announce is known in a run only, not to `check`
    ├── PeerError              another process of the run is missing, gone, or of another mind
    ├── WireError              bytes from elsewhere that are no event, or an event that cannot leave
    ├── MissingAnswerError     a system outside the process did not answer, or is gone
    ├── UnraisableError        a call in a thread or worker raised what no coroutine may
    └── WorkerError
        ├── WorkerDiedError    the process ended: name, exit code and last output
        └── WorkerTimeoutError the process did not answer in time

The command line prints any of these as one line and ends with exit code 2.
"""

from __future__ import annotations

import concurrent.futures
import difflib
from collections.abc import Iterable

_LONGEST = 1500  # characters of a message


class VisnavError(Exception):
    """Base of every error below."""


class ConfigError(VisnavError):
    """Wrong configuration; the message names the place, the expected and the found value.

    A long message is cut in the middle.
    """

    def __init__(self, message: str) -> None:
        if len(message) > _LONGEST:
            message = f"{message[: _LONGEST // 2]} … {message[-_LONGEST // 4 :]}"
        super().__init__(message)


class DeclarationError(VisnavError):
    """Wrong declaration in a node's class, for its author to mend."""


class MissingDependencyError(VisnavError):
    """Missing library; the message holds the command to install the library."""


class UnsupportedInterpreterError(VisnavError):
    """The interpreter cannot do as the file asks; another Python can."""


class NodeError(VisnavError):
    """A node failed."""

    def __init__(self, node: str, what: str) -> None:
        super().__init__(f"{node}: {what}")
        self.node = node
        self.place = ""  # line of the node where an exception other than ours was raised, if known


class FatalError(NodeError):
    """A node called `log.fatal`: the run cannot go on."""


class RefusedError(NodeError):
    """A node cannot work with another node's announcement."""


class NodeTimeoutError(NodeError):
    """A node's start-up or shutdown took longer than its limit."""


class UnraisableError(VisnavError, RuntimeError):
    """A call in a thread or worker raised what a coroutine takes for an order, not for an error.

    Such are `StopIteration`, `CancelledError`, `SystemExit`; it is this error's cause.
    """


def raisable(error: BaseException) -> Exception:
    """Return an error of a call beside the loop, or an `UnraisableError` of it, for a coroutine."""
    ends_loops = StopIteration, StopAsyncIteration, concurrent.futures.CancelledError
    if isinstance(error, Exception) and not isinstance(error, ends_loops):
        return error
    try:
        text = str(error)
    except Exception:  # its own fault, too
        text = "a message that cannot be made"
    made = UnraisableError(f"{type(error).__name__}: {text}")
    made.__cause__ = error
    return made


class ChannelError(VisnavError):
    """Base of errors between a sender and a receiver."""


class ChannelFullError(ChannelError):
    """An input with ``overflow="error"`` has no room for another event."""


class ChannelClosedError(ChannelError):
    """The input is closed, and its events have been read."""


class ChannelBusyError(ChannelError):
    """A second coroutine tried to wait on an input with a waiting reader."""


class HandlerCircleError(ChannelError):
    """Handlers of several nodes answer each other without end."""


class ChannelSourceError(ChannelError):
    """An event or an announcement uses the source of another node."""


class ChannelTypeError(ChannelError, TypeError):
    """An output was sent an undeclared type of event, or data without a digest."""


class ChannelThreadError(ChannelError):
    """An event was sent in a thread other than the loop's."""


class AmbiguousSourceError(ChannelError):
    """Two sources send events for the same field of a bundle; the file must choose."""


class CommandError(VisnavError):
    """A command cannot be carried out; the message says why."""


class ResultsError(VisnavError):
    """A run's folder belongs to something else, or is not writable."""


class UncheckableError(VisnavError):
    """A node cannot know its announcements while a file is only checked."""


class PeerError(VisnavError):
    """Another process of the run is missing, gone or incompatible."""


class WireError(VisnavError):
    """Bytes are no event known to this process, or an event has no form in bytes."""


class MissingAnswerError(VisnavError):
    """A system outside the process did not answer a frame in time, or is gone."""


class WorkerError(VisnavError):
    """Base of errors of a worker process."""


class WorkerDiedError(WorkerError):
    """A worker process ended on its own."""


class WorkerTimeoutError(WorkerError):
    """A worker process did not answer within its limit and was killed."""


def expect_known(
    name: str, known: Iterable[str], message: str, error: type[VisnavError] = ConfigError
) -> None:
    """Raise an error with a message, and a suggestion, unless a name is known."""
    known = list(known)
    if name not in known:
        raise error(message + suggest(name, known))


def suggest(word: str, known: Iterable[str]) -> str:
    """Return ``" (did you mean 'x'?)"`` if something known is close to `word`, else ``""``."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean {near[0]!r}?)" if near else ""
