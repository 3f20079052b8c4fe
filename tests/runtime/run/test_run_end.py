"""How a run ended, as its nodes read it in their last phases: when, why, by whom, as planned?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    LidarScan,
    Odometry,
    PoseEstimate,
    PoseStamped,
    Shutdown,
    VehicleAnnouncement,
    WindowClosed,
)
from runtime import Bundle, Input, Node, Output, on
from runtime.config.model import NodeSpec
from runtime.host import RunEnd
from runtime.node import NodeConfig
from runtime.testing import spec
from tests.runtime.samples import Ping
from tests.runtime.samples_runs import supervise


class HowConfig(NodeConfig):
    how: str = "stop"


class Ends(Node[HowConfig]):
    """Ends the run after 0.2 s, somehow."""

    shutdowns = Output(Shutdown)
    closures = Output(WindowClosed)

    async def run(self) -> None:
        await self.clock.sleep(0.2)
        match self.config.how:
            case "stop":
                self.stop("enough")
            case "shutdown":
                self.shutdowns.send(Shutdown(stamp=0, source=self.name, reason="enough"))
            case "below":
                self.shutdowns.send(Shutdown(stamp=0, source=f"{self.name}/x", reason="enough"))
            case "raise":
                raise ValueError("too much")
            case "fatal":
                self.log.fatal("too much")
            case "close":
                self.closures.send(WindowClosed(stamp=0, source=self.name))


class Pilot(Ends):
    flies = True


class Replayer(Ends):
    ends_run = "plan"


class Window(Ends):
    ends_run = "hand"


class Announces(Ends):
    """Ends the run as an estimator."""

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source="in another name", method="none")


class Estimates(Ends):
    """Ends the run as an estimator that has announced nothing."""

    estimates = Output(PoseEstimate)

    async def run(self) -> None:
        place: dict[str, Any] = {"position": (0.0, 0.0, 0.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
        self.estimates.send(PoseEstimate(stamp=0, source=self.name, **place))
        await super().run()


def claiming(node: type[Ends], **claims: Any) -> type[Ends]:
    """Return an estimator that says to be a part of the flight."""
    return type(f"{node.__name__}{claims}", (node,), claims)


class Reader(Node):
    """Keeps how the run ended."""

    ends: list[Any]

    async def on_startup(self) -> None:
        Reader.ends = [self.run_end]

    async def on_end(self) -> None:
        Reader.ends.append(self.run_end)

    async def on_shutdown(self) -> None:
        Reader.ends.append(self.run_end)


def ended(*nodes: NodeSpec, **run: Any) -> RunEnd:
    """Run nodes after a reader, and return how the reader says that the run ended."""
    supervise([spec(Reader, "reader"), *nodes], **run)
    before, end, again = Reader.ends
    assert before is None
    assert end is again
    assert isinstance(end, RunEnd)
    return end


@pytest.mark.parametrize(
    ("node", "how", "expected"),
    [
        (Ends, "nothing", ("", "duration", "", True)),
        (Ends, "stop", ("x", "enough", "", False)),
        (Ends, "shutdown", ("x", "x: enough", "", False)),
        (Ends, "below", ("x", "x/x: enough", "", False)),
        (Ends, "raise", ("x", "x failed", "x: ValueError: too much", False)),
        (Ends, "fatal", ("x", "x failed", "x: too much", False)),
        (Ends, "close", ("x", "x: WindowClosed", "", False)),
        (Pilot, "shutdown", ("x", "x: enough", "", True)),
        (Pilot, "raise", ("x", "x failed", "x: ValueError: too much", False)),
        (Replayer, "stop", ("x", "enough", "", True)),
        (Window, "close", ("user", "x: WindowClosed", "", False)),
        (Window, "raise", ("x", "x failed", "x: ValueError: too much", False)),
    ],
)
def test_a_run_says_who_ended_it_and_whether_that_was_the_plan(
    node: type[Ends], how: str, expected: tuple[str, str, str, bool]
) -> None:
    end = ended(spec(node, "x", {"how": how}), spec(Ends, "x_too", {"how": "nothing"}))
    assert (end.by, end.reason, end.error, end.planned) == expected
    assert end.stamp == (1_000_000_000 if not end.by else 200_000_000)
    assert end.duration == 1.0


@pytest.mark.parametrize("node", [Announces, Estimates])
@pytest.mark.parametrize(
    "claims",
    [{"flies": True}, {"ends_run": "plan"}, {"ends_run": "hand"}, {"relays_estimates": True}],
)
def test_an_estimator_is_no_pilot_whatever_its_class_says(
    node: type[Ends], claims: dict[str, Any]
) -> None:
    for how in ("stop", "shutdown"):
        end = ended(spec(claiming(node, **claims), "x", {"how": how}))
        assert (end.by, end.planned) == ("x", False)


def test_a_relay_of_this_project_may_end_the_run_as_planned() -> None:
    class Relay(Estimates):
        relays_estimates = True
        ends_run = "plan"

    Relay.__module__ = "nodes.data.replay"
    end = ended(spec(Relay, "x", {"how": "stop"}))
    assert (end.by, end.planned) == ("x", True)


@pytest.mark.parametrize(("others", "planned"), [([], True), ([Replayer], False)])
def test_a_person_may_end_what_has_no_plan(others: list[type[Ends]], planned: bool) -> None:
    nodes = [spec(node, f"other{i}", {"how": "nothing"}) for i, node in enumerate(others)]
    end = ended(spec(Window, "x", {"how": "close"}), *nodes, duration=0.0)
    assert (end.by, end.planned) == ("user", planned)


def test_a_run_counts_how_often_a_node_was_brought_up_anew() -> None:
    end = ended(spec(Ends, "x", {"how": "raise"}, on_error="restart"), duration=1.5)
    assert end.restarts == {"reader": 0, "x": 1}
    assert (end.by, end.planned) == ("", True)


class Chatterbox(Node):
    """Lets others make it speak."""

    pings = Output(Ping)

    async def on_startup(self) -> None:
        self.share("speak", lambda: self._speak)

    def _speak(self, count: int) -> None:
        self.pings.send(Ping(stamp=self.clock.now(), source=self.name, count=count))


class Pair(NamedTuple):
    ping: Ping


class Busy(Node):
    """Works beside the loop as it ends, while others go on speaking."""

    read = Input(Ping)
    paired = Bundle(Pair)
    counts: list[Any]

    async def run(self) -> None:
        Busy.counts = []
        self._let_speak(1)
        self.stop("enough")

    @on(Ping)
    def hear(self, event: Ping) -> None:
        Busy.counts.append(event.count)

    @on(Ping)
    def hear_late(self, event: Ping) -> None:
        Busy.counts.append(f"late {event.count}")

    async def on_shutdown(self) -> None:
        self._let_speak(2)
        if self.clock.kind == "real":
            await self.clock.sleep(0.03)  # what was under way would have come by then
        Busy.counts += [self.read.receive_nowait().count, self.paired.receive_nowait().ping.count]
        Busy.counts += [self.read.statistics().buffered, self.paired.statistics().buffered]

    def _let_speak(self, count: int) -> None:
        speak: Callable[[int], None] = self.share("speak", lambda: lambda _: None)
        speak(count)


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_node_receives_nothing_while_it_shuts_down(clock: str) -> None:
    """What it writes beside the loop stays as it is; what came before can still be read."""
    busy = spec(Busy, "busy", links={"hear_late": {"delay": "10ms"}})
    outcome = supervise([spec(Chatterbox, "box"), busy], clock=clock)
    assert outcome.error is None
    assert [ping.count for ping in outcome.sent if isinstance(ping, Ping)] == [1, 2]
    assert Busy.counts == [1, 1, 1, 0, 0]  # by the handler, the stream and the bundle; no more


class Vehicle(Node):
    flies = True
    odometry = Output(Odometry)

    def announce(self) -> Iterable[Announcement]:
        place: dict[str, Any] = {"position": (0.0, 0.0, 0.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
        figures: dict[str, Any] = {"mass": 1.0, "max_thrust": 20.0, "control_rate": 400.0}
        yield VehicleAnnouncement(stamp=0, source=self.name, **figures, **place)


class EstimatorConfig(NodeConfig):
    reads: tuple[str, ...] = ("rgb",)


class Estimator(Node[EstimatorConfig]):
    def announce(self) -> Iterable[Announcement]:
        reads = self.config.reads
        yield EstimatorAnnouncement(stamp=0, source=self.name, method="none", reads=reads)


class Peeps(Estimator):
    @on(Odometry)
    def peep(self, _: Odometry) -> None: ...


class PeepsAtCameras(Estimator):
    poses = Input(PoseStamped)


class Shows(Peeps):
    reads_truth = "showing"


class Flies(Peeps):
    flies = True


class Relays(Shows):
    relays_estimates = True


class RelaysOurs(Relays): ...


RelaysOurs.__module__ = "nodes.bridge"


class FromElsewhere(Estimator):
    @on(Odometry, source="other")
    def peep(self, _: Odometry) -> None: ...


@pytest.mark.parametrize(
    ("node", "reads", "truth_readers", "warned"),
    [
        (Estimator, ["rgb"], set(), False),
        (Peeps, ["rgb"], {"x"}, True),
        (Peeps, ["truth"], {"x"}, False),
        (PeepsAtCameras, ["rgb"], set(), False),  # there is no camera
        (Shows, ["rgb"], {"x"}, True),
        (Flies, ["rgb"], {"x"}, True),
        (Relays, ["rgb"], {"x"}, True),
        (RelaysOurs, ["rgb"], set(), False),
        (FromElsewhere, ["rgb"], set(), False),
    ],
)
def test_a_run_says_who_received_the_truth(
    node: type[Estimator],
    reads: list[str],
    truth_readers: set[str],
    warned: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    end = ended(spec(Vehicle, "drone"), spec(node, "x", {"reads": reads}))
    assert end.truth_readers == truth_readers
    assert end.truth_relays == ({"x"} if node is RelaysOurs else set())
    told = [record.getMessage() for record in caplog.records]
    assert told == (["x: receives true poses, and does not announce so"] if warned else [])


class Rig(Vehicle):
    def announce(self) -> Iterable[Announcement]:
        yield from super().announce()
        info = CameraInfo(width=4, height=4, fx=2.0, fy=2.0, cx=1.5, cy=1.5)
        for name in ("left", "right"):
            yield CameraAnnouncement(
                stamp=0,
                source=f"{self.name}/{name}",
                frame_id=name,
                parent_frame_id="base_link",
                info=info,
                rate=30.0,
                latency=0.0,
                images=("rgb", "grey"),
                position=(0.0, 0.0, 0.0),
                orientation=(1.0, 0.0, 0.0, 0.0),
            )


class ReadsAll(Estimator):
    images = Input(Image)


class ReadsGrey(Estimator):
    images = Input(Image, source="drone/left/grey")


class ReadsDepth(Estimator):
    images = Input(DepthImage, source="drone/right")


class ReadsScans(Estimator):
    images = Input(LidarScan)


class Announced(Estimator):
    """Chooses its camera once it is announced."""

    images = Input(Image)

    def on_announcement(self, announcement: Announcement) -> None:
        if announcement.source == "drone/right":
            self.narrow("images", announcement.source)


@pytest.mark.parametrize(
    ("node", "read"),
    [
        (ReadsAll, {"drone/left", "drone/right"}),
        (ReadsGrey, {"drone/left"}),
        (ReadsDepth, {"drone/right"}),
        (Announced, {"drone/right"}),
        (ReadsScans, None),
    ],
)
def test_a_run_knows_which_cameras_a_node_reads(
    node: type[Estimator], read: set[str] | None
) -> None:
    end = ended(spec(Rig, "drone"), spec(node, "x"))
    assert end.read.get("x") == read
    assert end.owners["drone/left"] == "drone"
