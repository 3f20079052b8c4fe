"""``T_BS``: a mounting as a matrix is what its numbers say, wherever a mounting is given."""

from __future__ import annotations

import tomllib
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events.geometry import pose_matrix
from runtime.config.reading import convert, parse
from runtime.errors import ConfigError
from sims.cameras import CameraSpec, announcement, optical_in_body
from sims.cameras.spec import eyes
from sims.sensors.imu import ImuParameters
from sims.sensors.lidar import LidarSpec
from sims.sensors.rays import RangeFinderSpec
from sims.sensors.sensor import Mount

EUROC = (
    "[0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,\n"
    " 0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,\n"
    " -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,\n"
    " 0.0, 0.0, 0.0, 1.0]"
)
"""T_BS of cam0 of EuRoC."""

LOOKING_DOWN = [[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.05], [0, 0, 0, 1.0]]
"""A camera whose image has the right side of the vehicle at its right, and its front above."""


def in_body(spec: CameraSpec) -> Any:
    return pose_matrix(*optical_in_body(spec))


@settings(max_examples=20)
@given(rotation=st.tuples(*[st.floats(-4, 4)] * 3), place=st.tuples(*[st.floats(-2, 2)] * 3))
def test_a_camera_is_where_its_matrix_has_it(
    rotation: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    matrix[:3, 3] = place
    spec = convert({"name": "c", "T_BS": matrix.tolist()}, CameraSpec, "camera")
    np.testing.assert_allclose(in_body(spec), matrix, atol=1e-12)
    imu = convert({"T_BS": matrix.tolist()}, ImuParameters, "imu")
    np.testing.assert_allclose(pose_matrix(imu.position, imu.rotation), matrix, atol=1e-12)


def test_straight_down_is_exact() -> None:
    """Where roll and yaw are one, and an arc sine would lose half of the digits."""
    spec = convert({"name": "c", "T_BS": LOOKING_DOWN}, CameraSpec, "camera")
    assert spec.orientation == pytest.approx((0.0, -90.0, 0.0))
    assert spec.position == (0.1, 0.0, 0.05)
    np.testing.assert_allclose(in_body(spec), LOOKING_DOWN, atol=1e-15)


def test_a_sensor_yaml_is_copied_as_it_is() -> None:
    """The table with rows, cols and data; the settings hold position and angles from then on."""
    table = tomllib.loads(f'name = "cam0"\n[T_BS]\nrows = 4\ncols = 4\ndata = {EUROC}')
    spec = convert(table, CameraSpec, "camera")
    expected = np.reshape([float(n) for n in EUROC.strip("[]").split(",")], (4, 4))
    np.testing.assert_allclose(in_body(spec), expected, atol=1e-9)
    assert spec.T_BS is None
    assert msgspec.structs.replace(spec, width=100).position == spec.position
    announced = announcement(spec, source="drone/cam0", prefix="", parent_frame_id="base_link")
    np.testing.assert_allclose(
        pose_matrix(announced.position, announced.orientation), expected, atol=1e-9
    )


def test_of_a_rig_it_is_the_left_cameras() -> None:
    table = {"name": "c", "T_BS": LOOKING_DOWN, "stereo": {"baseline": 0.2}}
    left, right = eyes(convert(table, CameraSpec, "camera"))
    np.testing.assert_allclose(in_body(left), LOOKING_DOWN, atol=1e-15)
    np.testing.assert_allclose(
        np.linalg.inv(in_body(left)) @ in_body(right), moved(0.2), atol=1e-12
    )


def moved(right: float) -> Any:
    matrix = np.eye(4)
    matrix[0, 3] = right
    return matrix


def every(kind: type[Any]) -> list[type[Any]]:
    return [kind, *(below for child in kind.__subclasses__() for below in every(child))]


@pytest.mark.parametrize("kind", every(Mount))
def test_every_sensor_takes_it(kind: type[Any]) -> None:
    named = {"name": "s"} if issubclass(kind, LidarSpec | RangeFinderSpec) else {}
    spec = convert({**named, "T_BS": LOOKING_DOWN}, kind, "sensor")
    np.testing.assert_allclose(pose_matrix(spec.position, spec.rotation), LOOKING_DOWN, atol=1e-15)


@pytest.mark.parametrize(
    ("matrix", "wrong"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "T_BS: expected a rotation, a position and a l"),
        (np.diag([2.0, 1.0, 1.0, 1.0]).tolist(), "T_BS: expected a rotation"),
        (np.eye(4)[[0, 1, 3, 2]].tolist(), "T_BS: expected a rotation"),
        (np.eye(3).tolist(), "T_BS: expected"),
        ({"data": [1.0] * 15}, r"T_BS\.data: expected"),
        ({"rows": 3, "data": np.eye(4).ravel().tolist()}, r"T_BS\.rows: expected a whole number"),
    ],
)
def test_what_is_no_mounting_is_refused_by_place(matrix: Any, wrong: str) -> None:
    with pytest.raises(ConfigError, match=rf"\(drone\): cameras\[0\](\.|: ){wrong}"):
        parse(
            {
                "nodes": [
                    {
                        "name": "drone",
                        "type": "Multirotor",
                        "cameras": [{"name": "c", "T_BS": matrix}],
                    }
                ]
            },
            "file",
        )


@pytest.mark.parametrize("beside", [{"position": [0, 0, 0]}, {"orientation": [0, 0, 1]}])
def test_it_stands_in_the_place_of_position_and_angles(beside: dict[str, Any]) -> None:
    (name,) = beside
    wrong = f"T_BS: expected it in the place of .*, found {name} beside it"
    with pytest.raises(ConfigError, match=wrong):
        convert({"name": "c", "T_BS": LOOKING_DOWN, **beside}, CameraSpec, "camera")
