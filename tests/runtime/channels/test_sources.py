"""A node sends in its own name, or in one that it announces: never in another's."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

from events import (
    Announcement,
    EstimatorAnnouncement,
    Event,
    Imu,
    Odometry,
    PilotAnnouncement,
    PoseEstimate,
    TrackingLost,
)
from runtime import Node, NodeConfig, Output
from runtime.channels.sources import SourceOwners
from runtime.errors import ChannelSourceError, NodeError
from runtime.testing import any_source, run_nodes, spec
from tests.runtime.samples_runs import supervise
from tests.runtime.small_events import said

PLACE: dict[str, Any] = {"position": (0.0, 0.0, 0.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
POSE: dict[str, Any] = PLACE | {"frame_id": "odom", "child_frame_id": "body"}
TRUTH: dict[str, Any] = POSE | {
    "linear_velocity": (0.0, 0.0, 0.0),
    "angular_velocity": (0.0, 0.0, 0.0),
}


class NamesConfig(NodeConfig):
    announced: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    kind: str = "estimate"


class Speaker(Node[NamesConfig]):
    """Announces and sends in the names that its settings list."""

    odometry = Output(Odometry)
    estimates = Output(PoseEstimate)
    anything = Output(Event)

    def announce(self) -> Iterable[Announcement]:
        return [Announcement(stamp=0, source=source) for source in self.config.announced]

    async def run(self) -> None:
        for source in self.config.sources:
            match self.config.kind:
                case "truth":  # of a moment that is yet to come
                    self.odometry.send(Odometry(stamp=10**12, source=source, **TRUTH))
                case "estimate":
                    self.estimates.send(PoseEstimate(stamp=0, source=source, **POSE))
                case "lost":
                    self.anything.send(TrackingLost(stamp=0, source=source))


def sources_of(*sources: str, announced: tuple[str, ...] = (), kind: str = "estimate") -> list[str]:
    """Return the sources of what a node ``cheat`` sends beside ``drone`` and ``tracker``."""
    result = run_nodes(
        [
            spec(Speaker, "drone", {"announced": ["drone/imu", "rig"]}),
            spec(Speaker, "tracker"),
            spec(Speaker, "cheat", {"sources": sources, "announced": announced, "kind": kind}),
        ]
    )
    return [event.source for event in result.sent if not isinstance(event, Announcement)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sources", "announced"),
    [
        (("cheat", "cheat/a", "cheat"), ()),
        (("slam", "slam/map"), ("slam",)),
        (("odd", "cheat", "even"), ("*",)),
    ],
)
def test_a_node_speaks_for_itself_and_for_those_that_it_announces(
    sources: tuple[str, ...], announced: tuple[str, ...]
) -> None:
    for kind in ("truth", "estimate", "lost"):
        assert sources_of(*sources, announced=announced, kind=kind) == list(sources)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "whose"),
    [
        ("drone", "which is drone's"),
        ("drone/imu", "which is drone's"),
        ("rig/left", "which is drone's"),
        ("tracker", "which is tracker's"),
        ("cheat2", "which nobody announces"),
    ],
)
@pytest.mark.parametrize(
    ("kind", "port"),
    [
        ("truth", "odometry: expected"),
        ("estimate", "estimates: expected"),
        ("lost", "anything: expected"),
    ],
)
def test_a_node_that_speaks_for_another_fails_with_both_names(
    kind: str, port: str, source: str, whose: str
) -> None:
    for announced in ((), ("*",)):
        if announced and "nobody" in whose:
            continue
        with pytest.raises(NodeError) as caught:
            sources_of("cheat", source, announced=announced, kind=kind)
        text = str(caught.value)
        assert text.startswith(f"cheat: cheat.{port}")
        assert f"{source!r}, {whose}" in text


@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("kind", ["truth", "estimate", "lost"])
def test_it_is_noticed_with_and_without_a_digest_after_events_that_were_right(
    clock: str, kind: str
) -> None:
    cheat = spec(Speaker, "cheat", {"sources": ["cheat", "cheat", "drone"], "kind": kind})
    outcome = supervise([spec(Speaker, "drone"), cheat], clock=clock, duration=0.2)
    assert outcome.supervisor.state.run_end is not None
    assert outcome.supervisor.state.run_end.by == "cheat"
    assert "'drone', which is drone's" in str(outcome.error)


@pytest.mark.parametrize(
    ("announced", "expected"),
    [
        (["a"], "Announcement of 'a', which is a's"),
        (["a/x"], "Announcement of 'a/x', which is a's"),
        (["shared"], "Announcement of 'shared', which is a's"),
    ],
)
def test_nobody_announces_what_is_anothers(announced: list[str], expected: str) -> None:
    nodes = [
        spec(Speaker, "a", {"announced": ["shared"]}),
        spec(Speaker, "b", {"announced": announced}),
    ]
    with pytest.raises(NodeError) as caught:
        run_nodes(nodes)
    assert str(caught.value).startswith("b: ")
    assert expected in str(caught.value)


def test_a_script_of_a_test_may_speak_for_anybody() -> None:
    @any_source
    class Script(Speaker):
        pass

    nodes = [spec(Speaker, "drone"), spec(Script, "x", {"sources": ["drone", "y"]})]
    imu = Imu(
        stamp=0,
        source="drone",
        angular_velocity=(0.0, 0.0, 0.0),
        linear_acceleration=(0.0, 0.0, 0.0),
    )
    assert [event.source for event in run_nodes(nodes, inputs=[imu]).sent] == ["drone", "y"]


def test_who_announces_a_star_sends_what_nobody_else_owns() -> None:
    owners = SourceOwners(["replay", "drone"], ["script"])
    odd, below = (said(source=source) for source in ("odd", "drone/imu/raw"))
    with pytest.raises(ChannelSourceError, match="'odd', which nobody announces"):
        owners.check("replay.anything", odd)
    owners.announce("replay", Announcement(stamp=0, source="*"))
    owners.check("replay.anything", odd)
    with pytest.raises(ChannelSourceError, match="'drone/imu/raw', which is drone's"):
        owners.check("replay.anything", below)
    with pytest.raises(ChannelSourceError, match="'odd', which nobody announces"):
        owners.check("drone.anything", odd)
    owners.check("script.anything", below)
    owners.announce("script", Announcement(stamp=0, source="drone"))
    assert [owners.owner(name) for name in ("drone/imu/raw", "odd", "dron")] == [
        "drone",
        None,
        None,
    ]


def test_a_source_is_announced_once_as_each_kind() -> None:
    owners = SourceOwners(["a"])
    estimator = EstimatorAnnouncement(stamp=0, source="a/x", method="")
    owners.announce("a", estimator)
    owners.announce("a", PilotAnnouncement(stamp=0, source="a/x"))
    for _ in range(2):
        owners.announce("a", Announcement(stamp=0, source="a/x"))
    with pytest.raises(ChannelSourceError, match=r"^a: .* EstimatorAnnouncement of 'a/x' twice$"):
        owners.announce("a", estimator)
