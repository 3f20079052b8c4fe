"""The suite finds what is wrong: estimators that are bad, each in its own way, and a good one."""

from __future__ import annotations

import itertools
from typing import Any, ClassVar

import numpy as np
import pytest

from events import EstimatorAnnouncement, PoseEstimate, TrackingLost, TrackingRegained
from nodes.estimators import Estimator, RgbdFrame, TrackingResult
from runtime import Bundle
from tests.nodes.estimators.conformance import Case, faults, lacks, refusal_faults, run
from tests.nodes.estimators.flight import Flight, fly

COUNT = itertools.count()


def flight() -> Flight:
    return fly(("depth", "grey"), 1, 240)


class Good(Estimator):
    """Knows the truth, and what is wrong with an image."""

    needs = frozenset({"grey", "depth"})
    lenses = frozenset()
    method = "truth"
    frames = Bundle(RgbdFrame, keep="latest")
    slow: ClassVar[bool] = False

    async def run(self) -> None:
        began = False
        async for image, _ in self.frames:
            await self.clock.sleep(0.015 + 0.01 * self.slow)
            result = self.track(image.stamp)
            began = began or not result.lost
            if began:
                self.say(image, result)

    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)

    def track(self, stamp: int) -> TrackingResult:
        mount = np.eye(4)
        mount[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
        mount[0, 3] = 0.1
        start = flight().truth[min(flight().truth)] @ mount
        pose = np.linalg.inv(start) @ flight().truth[stamp] @ mount
        lost = flight().kinds[stamp] in "bwrhz"
        return TrackingResult(pose, lost, "it is dark" if lost else "")


class Early(Good):
    async def run(self) -> None:
        async for image, _ in self.frames:
            await self.clock.sleep(0.015)
            self.publish(image, self.track(image.stamp))

    def track(self, stamp: int) -> TrackingResult:
        result = super().track(stamp)
        return TrackingResult(result.pose) if stamp < 200_000_000 else result


class NeverLost(Good):
    def track(self, stamp: int) -> TrackingResult:
        return TrackingResult(super().track(stamp).pose)


class Liar(Good):
    """Is off by 20 cm after the loss."""

    def track(self, stamp: int) -> TrackingResult:
        result = super().track(stamp)
        result.pose[0, 3] += 0.2 * (stamp > 1_700_000_000)
        return result


class Late(Good):
    slow = True


class Silent(Good):
    async def run(self) -> None:
        async for _ in self.frames:
            pass


class Gaps(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        if image.stamp % 150_000_000:
            self.publish(image, result)


class Twice(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        self.publish(image, result)


class OtherStamps(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.estimates.send(
            PoseEstimate(
                stamp=image.stamp - 1, source=self.name, position=(0, 0, 0),
                orientation=(1, 0, 0, 0),
            )
        )  # fmt: skip


class NoUnit(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        position = tuple(flight().truth[image.stamp][:3, 3].tolist())
        self.estimates.send(
            PoseEstimate(
                stamp=image.stamp, source=self.name, position=position,
                orientation=(1.0, 0.01, 0.0, 0.0), frame_id="map",
            )
        )  # fmt: skip


class TwoFrames(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        if image.stamp == 1_000_000_000:
            self._mounts = {}


class Talks(Good):
    """Goes on with poses while it is lost."""

    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        if result.lost:
            mount = self._mount(result.map, image.stamp)
            self.estimates.send(mount.estimate(image.stamp, self.name, result))


class LostTwice(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        if result.lost:
            event = TrackingLost(stamp=image.stamp, source=self.name, reason="again")
            self.tracking_events.send(event)


class Regained(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        self.tracking_events.send(TrackingRegained(stamp=image.stamp, source=self.name))


class WrongTrajectory(Good):
    async def on_end(self) -> None:
        self.publish_trajectory(np.array([1, 2]), np.stack([np.eye(4)] * 2))


class Gives(Good):
    async def on_end(self) -> None:
        stamps = [*flight().truth][4:9]
        poses = np.stack([self.track(stamp).pose for stamp in stamps])
        self.publish_trajectory(np.array(stamps), poses)


class Nameless(Good):
    method = ""


class Stops(Good):
    def say(self, image: Any, result: TrackingResult) -> None:
        self.publish(image, result)
        if image.stamp == 2_000_000_000:
            self.stop("it has seen enough")


BAD: dict[type[Good], str] = {
    Early: "says_nothing_before_it_knows",
    NeverLost: "marks_loss",
    Liar: "never_lies",
    Late: "is_as_late_as_declared",
    Silent: "begins",
    Gaps: "gives_a_pose_for_each_good_image",
    Twice: "says_poses_in_order",
    OtherStamps: "says_poses_in_order",
    NoUnit: "says_sound_poses",
    TwoFrames: "stays_in_one_frame",
    Talks: "marks_loss",
    LostTwice: "marks_loss",
    Regained: "marks_loss",
    WrongTrajectory: "corrects_what_it_was_sent",
    Nameless: "announces_what_it_reads",
    Stops: "ends_in_time",
}


@pytest.mark.parametrize("node", [Good, Gives])
def test_a_good_one_passes(node: type[Good]) -> None:
    assert not faults(run(Case(node), flight()), Case(node))


@pytest.mark.slow
@pytest.mark.parametrize("node", BAD)
def test_a_bad_one_is_found_out(node: type[Good]) -> None:
    reported = faults(run(Case(node), flight()), Case(node))
    assert BAD[node] in {fault.partition(":")[0] for fault in reported}


def test_equal_outcomes_are_equal_to_the_last_bit() -> None:
    class Random(Good):
        def track(self, stamp: int) -> TrackingResult:
            result = super().track(stamp)
            result.pose[0, 3] += 1e-15 * next(COUNT)
            return result

    first, second = (run(Case(Random), flight()).outcome() for _ in range(2))
    assert first != second
    assert run(Case(Good), flight()).outcome() == run(Case(Good), flight()).outcome()


def test_one_that_takes_what_it_cannot_use_is_found_out() -> None:
    class Careless(Good):
        def check(self) -> Any:
            return ()

        def announce(self) -> Any:
            yield EstimatorAnnouncement(
                stamp=0, source=self.name, method="x", reads=("depth", "grey"), eyes=1
            )

    refused = [[*refusal_faults(Case(Careless), lack)] for lack in lacks(Case(Careless))]
    assert refused
    assert all(refused)
