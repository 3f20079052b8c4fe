"""Runs that are driven by a script are equal if the script is, however slow the script is."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

import pytest

from runtime.channels.digest import Digest
from tests.sims.airsim.scripts import Caller, drone, with_script

YAW = {"is_rate": True, "yaw_or_rate": 0.0}


def fly(airsim: Caller) -> list[Any]:
    """Fly a little; the only waiting is for replies."""
    airsim("enableApiControl", True, "")
    airsim("armDisarm", True, "")
    replies = [airsim("takeoff", 20.0, "")]
    replies.append(airsim("moveToPosition", 1, 0, -2, 2, 3e38, 0, YAW, -1, 1, ""))
    replies.append(airsim("getMultirotorState", ""))
    replies.append(airsim("moveByVelocity", 0.0, 1.0, -0.5, 0.7, 0, YAW, ""))
    airsim("simContinueForTime", 0.31)
    replies.append(airsim("simGetVehiclePose", ""))
    replies.append(airsim("land", 30.0, ""))
    return [*replies, airsim("getMultirotorState", "")]


def step(airsim: Caller) -> list[Any]:
    """Fly a little, step by step; moves are not waited for."""
    airsim("enableApiControl", True, "")
    airsim("armDisarm", True, "")
    airsim.send("takeoff", 20.0, "")
    replies: list[Any] = []
    for index in range(12):
        airsim("simContinueForTime", 0.25)
        if index == 6:
            airsim.send("moveByVelocity", 1.0, 0.0, 0.0, 1.0, 0, YAW, "")
        airsim("simContinueForFrames", 3)
        replies.append(airsim("getMultirotorState", ""))
    return replies


@pytest.mark.parametrize(("flight", "setting"), [(fly, "awaited"), (step, "paused")])
def test_equal_scripts_give_equal_runs_and_replies(
    flight: Callable[[Caller], list[Any]],
    setting: str,
    tiny_world: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    send = Caller.send
    lags = random.Random()  # real delays, which differ in each run

    def slow(self: Caller, method: str, *arguments: Any) -> int:
        time.sleep(lags.choice([0.0, 0.0, 0.001, 0.02]))  # a script that computes meanwhile
        return send(self, method, *arguments)

    monkeypatch.setattr(Caller, "send", slow)
    seen = []
    for _ in range(3):
        replies: list[Any] = []
        result = with_script(
            lambda airsim, replies=replies: replies.extend(flight(airsim)),  # type: ignore[misc]
            [drone(world=tiny_world)],
            time=setting,
        )
        digest = Digest()
        for event in result.sent:
            digest(None, event)
        seen.append((digest.hexdigest(), result.seconds, replies))
    assert len(seen[0][2]) > 5
    assert seen[0][2][-1]["timestamp"] > 3_000_000_000
    assert seen[0] == seen[1] == seen[2]
