"""The handshake, and time that is paused and stepped by a client."""

from __future__ import annotations

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
