"""Wind, lines of sight, messages, and what is accepted without effect."""

from __future__ import annotations

import logging
import math

import pytest

from events.frames import to_geodetic
from sims.airsim.server.accepted import ACCEPTED
from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script

ORIGIN = (47.641468, -122.140165, 122.0)


def geo(x: float, y: float, z: float) -> dict[str, float]:
    latitude, longitude, altitude = to_geodetic((x, y, z), ORIGIN)
    return {"latitude": latitude, "longitude": longitude, "altitude": altitude}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x_val": x, "y_val": y, "z_val": z}


def test_wind_moves_what_flies_and_can_be_taken_back(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        def north() -> float:
            place = airsim("simGetObjectPose", "drone")["position"]
            return float(place["x_val"])

        def drift() -> float:
            start = north()
            airsim("simContinueForTime", 0.25)
            return north() - start

        assert abs(drift()) < 1e-6
        airsim("simSetWind", vector(20.0, 0.0, 0.0))
        gentle, strong = drift(), drift()
        assert strong > 2.0 * gentle > 0.01
        airsim("simSetWind", vector(0.0, 0.0, 0.0))
        assert drift() > drift() > strong  # it flies on, and the air brakes it
        for wrong in (math.nan, math.inf, 1e30):
            with pytest.raises(RefusedError, match="velocity: expected up to 50 m/s"):
                airsim("simSetWind", vector(0.0, wrong, 0.0))

    with_script(script, [drone(world=tiny_world, height=20.0)])


def test_lines_of_sight_end_at_walls(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        for place, is_seen in (((3.0, 0.0, -1.0), True), ((9.0, 0.0, -1.0), False)):
            assert airsim("simTestLineOfSightToPoint", geo(*place), "") is is_seen
            assert airsim("simTestLineOfSightBetweenPoints", geo(0, 0, -1), geo(*place)) is is_seen
        assert airsim("simTestLineOfSightBetweenPoints", geo(9, 9, -9), geo(9, 9, -9)) is True
        with pytest.raises(RefusedError, match="place: expected up to"):
            airsim("simTestLineOfSightToPoint", geo(0, 0, -1) | {"altitude": math.nan}, "")
        low, high = airsim("simGetWorldExtents")
        assert low["latitude"] < ORIGIN[0] < high["latitude"]
        assert high["altitude"] == pytest.approx(ORIGIN[2] + 6.0, abs=0.01)  # the wall's top
        assert low["altitude"] == pytest.approx(ORIGIN[2], abs=0.01)

    with_script(script, [drone(world=tiny_world)])


def test_the_level_is_the_world(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("simLoadLevel", tiny_world) is True
        assert airsim("simLoadLevel", "Neighborhood") is False
        with pytest.raises(RefusedError, match="writes no files"):
            airsim("simCreateVoxelGrid", vector(0, 0, 0), 1, 1, 1, 0.1, "/tmp/x")

    with_script(script, [drone(world=tiny_world)])


def test_messages_are_logged_by_their_severity(
    tiny_world: str, caplog: pytest.LogCaptureFixture
) -> None:
    def script(airsim: Caller) -> None:
        airsim("simPrintLogMessage", "hello ", "all", 0)
        airsim("simPrintLogMessage", "be\ncareful", "", 1)
        airsim("simPrintLogMessage", "x" * 9999, "", 2)
        airsim("simPrintLogMessage", "odd", "", 255)

    with caplog.at_level(logging.INFO, "visnav.airsim"):
        with_script(script, [drone(world=tiny_world)])
    records = [(record.levelno, record.getMessage()) for record in caplog.records]
    said = [each for each in records if "a client says" in each[1]]
    assert said[:2] == [
        (logging.INFO, "a client says: hello all"),
        (logging.WARNING, r"a client says: 'be\ncareful'"),
    ]
    assert said[2:] == [
        (logging.ERROR, f"a client says: {'x' * 500}"),
        (logging.INFO, "a client says: odd"),
    ]


def test_what_has_no_effect_is_accepted_and_logged_once(
    tiny_world: str, caplog: pytest.LogCaptureFixture
) -> None:
    def script(airsim: Caller) -> None:
        for _ in range(2):
            for method, (description, arguments) in ACCEPTED.items():
                expected = False if description.startswith("Return") else None
                assert airsim(method, *arguments.split()) is expected
        with pytest.raises(RefusedError, match="Expected: 2, got: 1"):
            airsim("simSetWeatherParameter", 0)

    with_script(script, [drone(world=tiny_world)])
    logged = [r.getMessage() for r in caplog.records if "has no effect here" in r.getMessage()]
    assert sorted(logged) == sorted(f"{method} has no effect here" for method in ACCEPTED)
