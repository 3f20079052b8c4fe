"""The cameras that clients know: their names, where they are, and what clients change."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.testing import spec
from sims.airsim.server.cameras import Capture, ServedCamera, cameras_by_name, default_mount
from sims.airsim.server.image_types import ImageType
from sims.cameras.spec import CameraSpec, Stereo
from sims.computer_vision import FreeCamera
from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script

NAMES = "front_center", "0", "", "fpv", "front_right", "1", "2", "bottom_center", "3", "4"


def vector(found: dict[str, float]) -> tuple[float, float, float]:
    return found["x_val"], found["y_val"], found["z_val"]


def info(call: Caller, name: str, vehicle: str = "") -> Any:
    return call("simGetCameraInfo", name, vehicle, False)


def test_a_vehicle_has_airsims_default_cameras(tiny_world: str) -> None:
    found = {}

    def script(call: Caller) -> None:
        found.update({name: info(call, name) for name in NAMES})

    with_script(script, [drone(world=tiny_world, yaw=90.0)])
    for name in NAMES:
        (x, y, z), (_, pitch, yaw) = default_mount(name, False)
        assert vector(found[name]["pose"]["position"]) == pytest.approx((-y, x, z), abs=1e-6)
        quaternion = found[name]["pose"]["orientation"]
        half = math.radians(90.0 + yaw) / 2.0
        expected = math.cos(half) * math.cos(math.radians(pitch) / 2.0)
        assert abs(quaternion["w_val"]) == pytest.approx(abs(expected), abs=1e-6)
    assert found["0"] == found[""] == found["fpv"] == found["front_center"] != found["1"]
    assert found["0"]["fov"] == 90.0
    assert found["0"]["proj_mat"]["matrix"] == [
        pytest.approx(row)
        for row in ([0, 1, 0, 0], [0, 0, -256 / 144, 0], [0, 0, 0, 10], [-1, 0, 0, 0])
    ]


def test_cameras_of_the_settings_and_of_the_file_go_before_default_ones() -> None:
    entries = [
        ServedCamera(name="front_center", captures=(Capture(image_type=5, fov=60.0),)),
        ServedCamera(name="fpv", orientation=(0.0, -90.0, 0.0)),
        ServedCamera(name="bottom_center", captures=(Capture(fov=30.0, width=100, height=200),)),
        ServedCamera(name="both", position=(1.0, 2.0, 3.0)),
    ]
    own = [
        CameraSpec(name="front_right", width=40, height=20, fov=120.0),
        CameraSpec(name="pair", stereo=Stereo(baseline=0.3)),
        CameraSpec(name="both"),
    ]
    found = cameras_by_name(own, entries, 3, free=False)
    assert found["0"] is found[""] is found["front_center"] is not found["fpv"]
    assert found["0"].eye(5).spec.fov == 60.0
    assert found["0"].eye(0).spec.fov == 90.0
    assert found["0"].mount == ((0.46, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert found["fpv"].mount[1] == pytest.approx((0.5**0.5, 0.0, -(0.5**0.5), 0.0))
    assert found["3"] is found["bottom_center"]
    assert found["3"].mount[0] == (0.0, 0.0, 0.12)
    assert found["3"].eye(0).spec.height == 200
    assert found["3"].eye(1).spec.height == 144
    assert found["1"] is found["front_right"]
    assert {found["1"].eye(kind).spec.width for kind in ImageType} == {40}
    assert found["pair_right"].mount[0] == pytest.approx((0.15, 0.3, 0.0))
    assert found["both"].mount[0] == (1.0, 2.0, 3.0)
    assert "pair" not in found
    assert found["4"].eye(0).body == 3


@given(st.sets(st.sampled_from(NAMES)), st.sets(st.sampled_from(NAMES)))
def test_default_names_are_always_there_and_given_ones_are_those_given(
    entries: set[str], own: set[str]
) -> None:
    found = cameras_by_name(
        [CameraSpec(name=name) for name in sorted(own)],
        [ServedCamera(name=name) for name in sorted(entries)],
        1,
        free=False,
    )
    assert found.keys() >= {*NAMES, "front_left", "back_center"}
    assert len({id(found[name]) for name in own | entries}) == len(own | entries)
    unnamed = len({default_mount(name, False) for name in set(found) - own - entries})
    assert len({id(camera) for camera in found.values()}) <= len(own | entries) + unnamed


def test_in_computer_vision_mode_the_cameras_are_at_the_body(tiny_world: str) -> None:
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        found.update({name: info(call, name) for name in ("0", "1", "3", "any")})

    settings = {"world": tiny_world, "camera_processes": 1, "position": [1, 2, -3]}
    with_script(script, [spec(FreeCamera, "free", settings | {"cameras": [{"name": "any"}]})])
    assert vector(found["0"]["pose"]["position"]) == pytest.approx((0, 0, 0))
    assert vector(found["1"]["pose"]["position"]) == pytest.approx((0, 0.125, 0))
    assert vector(found["3"]["pose"]["position"]) == pytest.approx((0, 0, 0))
    assert vector(found["any"]["pose"]["position"]) == pytest.approx((0.15, 0, 0))


def test_a_camera_that_is_not_there_fails_the_whole_call(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        info(call, "own", "other")
        with pytest.raises(RefusedError, match=r"expected a camera of drone .*, found 'own'\."):
            info(call, "own", "drone")
        with pytest.raises(RefusedError, match="'own'"):
            call("simGetImages", [{"camera_name": "0"}, {"camera_name": "own"}], "", False)
        with pytest.raises(RefusedError, match="external cameras"):
            call("simGetCameraInfo", "0", "", True)

    two = [drone(world=tiny_world), drone("other", position=[-3.0, 0.0])]
    with_script(script, two, cameras=[{"name": "own", "vehicle": "other"}])


def test_clients_move_cameras_and_change_their_view(tiny_world: str) -> None:
    pose = {
        "position": {"x_val": 0.5, "y_val": -0.25, "z_val": 1.0},
        "orientation": {"w_val": 1.0, "x_val": 0.0, "y_val": 0.0, "z_val": 1.0},
    }
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        call("simSetCameraPose", "fpv", pose, "", False)
        call("simSetCameraFov", "0", 60, "", False)
        found.update({name: info(call, name) for name in ("0", "1")})
        bad: dict[str, Any]
        for bad in (
            {"position": {"x_val": math.nan}},
            {"position": {"y_val": 1e300}},
            {"orientation": {"w_val": 0.0}},
            {"orientation": {"z_val": math.inf}},
        ):
            with pytest.raises(RefusedError, match="expected a rotation, and numbers up to 1e"):
                call("simSetCameraPose", "0", pose | bad, "", False)
        for degrees in (0.5, 171.0, math.nan, math.inf):
            with pytest.raises(RefusedError, match="expected a field of view of 1 to 170 degrees"):
                call("simSetCameraFov", "0", degrees, "", False)
        assert call("simGetDistortionParams", "0", "", False) == [0.0] * 5
        call("simSetDistortionParam", "0", "K1", 0, "", False)
        with pytest.raises(RefusedError, match=r"not supported by visnav-runtime: .*K1 = 0\.1"):
            call("simSetDistortionParam", "0", "K1", 0.1, "", False)
        assert info(call, "0") == found["0"]

    with_script(script, [drone(world=tiny_world)])
    assert vector(found["0"]["pose"]["position"]) == pytest.approx((0.5, -0.25, 1.0), abs=1e-5)
    assert found["0"]["pose"]["orientation"]["z_val"] == pytest.approx(math.sqrt(0.5))
    assert found["0"]["fov"] == 60.0
    assert found["1"]["fov"] == 90.0


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ([{"name": "a", "vehicle": "nobody"}], 'cameras: a: vehicle: .* found "nobody"'),
        (
            [{"name": "a"}, {"name": "a", "vehicle": "drone"}],
            r"found \['a', 'a'\]",
        ),
    ],
)
def test_wrong_settings_are_refused(
    tiny_world: str, cameras: list[dict[str, Any]], message: str
) -> None:
    with pytest.raises(Exception, match=message):
        with_script(lambda _: None, [drone(world=tiny_world)], cameras=cameras)


@pytest.mark.parametrize(
    "wrong",
    [{"projection": "orthographic"}, {"image_type": 12}, {"fov": 171.0}, {"width": 9000}],
    ids=str,
)
def test_wrong_captures_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError, match=next(iter(wrong))):
        msgspec.convert(wrong, Capture)
