"""The handshake, and time that is paused and stepped by a client."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script


def test_a_client_shakes_hands_and_steps_time(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("ping") is True
        assert airsim("getServerVersion") >= 4
        assert airsim("listVehicles") == ["a", "b"]
        assert airsim("simIsPaused") is True
        airsim("simContinueForTime", 0.25)
        assert airsim("simIsPaused") is True

    result = with_script(
        script,
        [drone("b", world=tiny_world), drone("a", world=tiny_world, position=(2.0, 0.0))],
    )
    assert result.seconds == 0.25


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (
            ("nonsense", 1),
            "rpclib: server could not find function 'nonsense' with argument count 1.",
        ),
        (
            ("simPause", True, 1),
            "rpclib: Function 'simPause' was called with an invalid number of arguments. "
            "Expected: 1, got: 2",
        ),
        (("simPause", "yes"), "Expected `bool`, got `str`"),
    ],
)
def test_what_cannot_be_served_is_refused(
    call: tuple[object, ...], error: str, tiny_world: str
) -> None:
    def script(airsim: Caller) -> None:
        with pytest.raises(RefusedError) as refused:
            airsim(*call)  # type: ignore[arg-type]
        assert error in str(refused.value)
        assert airsim("ping")

    with_script(script, [drone(world=tiny_world)])


def test_settings_are_handed_out_as_given_or_say_what_runs(tiny_world: str, tmp_path: Path) -> None:
    camera = {"name": "eye", "width": 320, "height": 200, "fov": 60.0}

    def described(airsim: Caller) -> None:
        found = json.loads(airsim("getSettingsString"))
        assert found["SimMode"] == "Multirotor"
        vehicle = found["Vehicles"]["drone"]
        assert (vehicle["VehicleType"], vehicle["X"]) == ("SimpleFlight", 2.0)
        scene = vehicle["Cameras"]["eye"]["CaptureSettings"][0]
        assert (scene["ImageType"], scene["Width"]) == (0, 320)
        assert scene["FOV_Degrees"] == pytest.approx(60.0)

    def given(airsim: Caller) -> None:
        assert airsim("getSettingsString") == ' {"a": 1.5}'

    def missing(airsim: Caller) -> None:
        with pytest.raises(RefusedError, match="settings: expected a readable file"):
            airsim("getSettingsString")

    path = tmp_path / "settings.json"
    path.write_text(' {"a": 1.5}')
    vehicle = drone(world=tiny_world, position=(2.0, 0.0), cameras=[camera])
    with_script(described, [vehicle])
    with_script(given, [drone(world=tiny_world)], settings=' {"a": 1.5}')
    with_script(given, [drone(world=tiny_world)], settings=str(path))
    with_script(missing, [drone(world=tiny_world)], settings=str(tmp_path / "other.json"))
