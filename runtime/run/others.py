"""Other processes of a run, as the supervisor sees them: none, or those of an extension."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain

from events import Announcement
from runtime.channels.sender import Listener
from runtime.channels.tasks import Fault
from runtime.summary import Summary
from runtime.time.clock import Clock


class Others:
    """No other processes: all nodes of the file run here.

    With others, the `Peers` of the extension visnav-machines stand in the place of this. The
    methods stand in the order in which a run calls them.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    async def meet(self) -> int:
        """Wait until all nodes of the file are there; return how often ours were lost before.

        Raises:
            PeerError: They are not within the limit, or one runs another file or our nodes.
        """
        return 0

    async def announce(self, local: Mapping[str, Iterable[Announcement]]) -> list[Announcement]:
        """Exchange announcements; return those of all nodes, in file order."""
        return list(chain(*local.values()))

    async def begin(self) -> None:
        """Agree with the others on the first update, and wait until then."""

    def start_clock(self) -> None:
        """Start the run's clock, if nobody else does."""
        self._clock.start()

    def nodes_run(self) -> None:
        """Deliver messages from now on: the nodes here have begun."""

    def listeners(self, output: str) -> list[Listener]:  # noqa: ARG002
        """Return an output's listeners in other processes."""
        return []

    def connect(self, listeners: list[Listener], fault: Fault) -> None:
        """Connect the listeners here to outputs elsewhere, and notify the others."""

    def stopping(self, reason: str, error: Exception | None, *, by: str, from_peer: bool) -> None:
        """Notify the others of the run's end and its reason, also if `from_peer`."""

    async def wait_to_end(self, node: str) -> None:
        """Wait until all nodes after `node` have ended, in any process; "" precedes all."""

    def node_ended(self, node: str) -> None:
        """Notify the others of the end of a node here."""

    async def leave(self, summary: Summary) -> Summary:
        """Exchange summaries and leave; return the summary of all processes."""
        return summary
