"""What is announced of an IMU and a lidar differs from the truth, by what the file says alone."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import visnav
from events import Imu, ImuAnnouncement, LidarAnnouncement, LidarScan, TransformStamped
from runtime.testing import NodeResult, run_node
from sims.multirotor import Multirotor
from sims.sensors.calibration import (
    USUAL_IMU,
    USUAL_LIDAR,
    ImuCalibrationError,
    LidarCalibrationError,
    announced,
)
from sims.sensors.imu import ImuParameters
from sims.sensors.lidar import LidarSpec
from tests.sims.vehicle.flight import WORLD

MOUNTING: dict[str, Any] = {"position": (0.1, 0.0, -0.05), "orientation": (0.5, 0.5, -0.5, 0.5)}
IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="drone/imu",
    parent_frame_id="base_link",
    gyroscope_noise_density=0.0,
    gyroscope_random_walk=0.0,
    accelerometer_noise_density=0.0,
    accelerometer_random_walk=0.0,
    gyroscope_matrix=(1.01, 0.002, 0.0, 0.0, 0.99, 0.0, 0.0, 0.0, 1.0),
    **MOUNTING,
)
LIDAR = LidarAnnouncement(
    stamp=0,
    source="drone/lidar",
    frame_id="drone/lidar",
    parent_frame_id="base_link",
    rate=10.0,
    latency=0.0,
    channels=16,
    columns=900,
    horizontal_fov=6.28,
    elevations=(-0.2, 0.2),
    noise=0.0,
    min_range=0.1,
    max_range=100.0,
    **MOUNTING,
)


def off(said: Any, true: Any) -> dict[str, np.ndarray]:
    """Return the errors of an announcement."""
    turn = Rotation.from_quat(true.orientation, scalar_first=True).inv()
    turn *= Rotation.from_quat(said.orientation, scalar_first=True)
    errors = {
        "rotation": np.degrees(turn.as_rotvec()),
        "position": np.subtract(said.position, true.position),
    }
    if isinstance(true, ImuAnnouncement):
        matrices = [
            np.subtract(getattr(said, name), getattr(true, name)).reshape(3, 3)
            for name in ("gyroscope_matrix", "accelerometer_matrix")
        ]
        errors["scale"] = np.ravel([np.diag(matrix) for matrix in matrices])
        rest = [matrix - np.diag(np.diag(matrix)) for matrix in matrices]
        assert not np.triu(rest[1]).any()  # it would be a rotation of the mounting
        aside = [rest[0][~np.eye(3, dtype=bool)], rest[1][np.tril_indices(3, -1)]]
        errors["misalignment"] = np.concatenate(aside)
    return errors


def drawn(true: Any, error: Any, name: str) -> Any:
    return announced(true, error, np.random.default_rng([5]), name)


@pytest.mark.parametrize(("true", "usual"), [(IMU, USUAL_IMU), (LIDAR, USUAL_LIDAR)])
def test_errors_have_the_deviations_of_the_settings(true: Any, usual: Any) -> None:
    errors = [off(drawn(true, usual, f"sensor{k}"), true) for k in range(500)]
    for name in usual.__struct_fields__:
        values = np.array([error[name] for error in errors])
        deviation = getattr(usual, name)
        assert values.std(axis=0) == pytest.approx(deviation, rel=0.15), name
        assert abs(values.mean(axis=0)).max() < 0.2 * deviation
        both = np.corrcoef(values.T)
        assert abs(both - np.eye(len(both))).max() < 0.2


@pytest.mark.parametrize(("true", "usual"), [(IMU, USUAL_IMU), (LIDAR, USUAL_LIDAR)])
def test_a_setting_changes_no_others_error_and_zero_changes_nothing(true: Any, usual: Any) -> None:
    kind = type(usual)
    assert drawn(true, kind(), "a") == true
    together = off(drawn(true, usual, "a"), true)
    for name in usual.__struct_fields__:
        alone = off(drawn(true, kind(**{name: getattr(usual, name)}), "a"), true)
        assert alone.pop(name) == pytest.approx(together[name], abs=1e-15)
        assert not any(values.any() for values in alone.values())
    parent = np.random.default_rng([5])
    state = parent.bit_generator.state
    assert announced(true, usual, parent, "a") == drawn(true, usual, "a")
    assert parent.bit_generator.state == state
    assert drawn(true, usual, "a") != drawn(true, usual, "b")


def test_lists_are_the_errors_themselves() -> None:
    aside = tuple(0.001 * k for k in range(1, 10))
    error = ImuCalibrationError(
        rotation=(0.0, 0.5, 0.0), scale=(0.01, 0, 0, 0, 0, -0.02), misalignment=aside
    )
    errors = off(drawn(IMU, error, "imu"), IMU)
    assert errors["rotation"] == pytest.approx([0.0, 0.5, 0.0])
    assert errors["scale"] == pytest.approx([0.01, 0, 0, 0, 0, -0.02])
    assert errors["misalignment"] == pytest.approx(aside)
    shift = LidarCalibrationError(position=(0.0, 0.02, 0.0))
    assert drawn(LIDAR, shift, "lidar").position == pytest.approx((0.1, 0.02, -0.05))


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        (ImuParameters, {"scale": [0.1] * 3}, r"calibration_error\.scale: .* 6 errors, .* of 3"),
        (ImuParameters, {"misalignment": [0.1] * 12}, r"misalignment: .* of 9 errors, .* of 12"),
        (ImuParameters, {"focal": 0.1}, "focal"),
        (LidarSpec, {"rotation": [0.1]}, r"calibration_error\.rotation: .* of 3 errors, .* of 1"),
        (LidarSpec, {"position": -0.1}, "position"),
    ],
)
def test_what_cannot_be_is_refused(kind: Any, error: dict[str, Any], message: str) -> None:
    more = {"name": "lidar"} if kind is LidarSpec else {}
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert({"calibration_error": error} | more, kind)


def flown(world: str, imu: Any, lidar: Any) -> NodeResult:
    config = {
        "world": world,
        "imu": {"calibration_error": imu},
        "lidars": [{"name": "lidar", "channels": 2, "columns": 32, "calibration_error": lidar}],
    }
    return run_node(Multirotor, config=config, duration=0.25, name="drone")


@pytest.mark.slow
@pytest.mark.parametrize("imu", [True, {"scale": 0.01}], ids=["usual", "matrix alone"])
def test_what_is_measured_stays_and_what_is_announced_errs(tmp_path: Any, imu: Any) -> None:
    path = tmp_path / "tiny.xml"
    path.write_text(WORLD)
    exact, errs = flown(str(path), False, False), flown(str(path), imu, True)
    for kind in (Imu, LidarScan):
        first, second = (
            [msgspec.structs.replace(e, frame_id="") for e in run.of(kind)] for run in (exact, errs)
        )
        assert first
        assert msgspec.msgpack.encode(first, enc_hook=bytes) == msgspec.msgpack.encode(
            second, enc_hook=bytes
        )
    kinds: list[Any] = [ImuAnnouncement, LidarAnnouncement]
    said, true = ([run.of(kind)[0] for kind in kinds] for run in (errs, exact))
    poses = {e.child_frame_id: (e.translation, e.rotation) for e in errs.of(TransformStamped)}
    assert said[0].gyroscope_matrix != true[0].gyroscope_matrix
    assert said[1].position != true[1].position
    assert poses["drone/lidar"] == (said[1].position, said[1].orientation)
    # An IMU that is not announced where the body is has a frame of its own.
    frame = "drone/imu" if imu is True else "base_link"
    assert {said[0].frame_id, *(e.frame_id for e in errs.of(Imu))} == {frame}
    if imu is True:
        assert poses["drone/imu"] == (said[0].position, said[0].orientation)
    else:
        assert "drone/imu" not in poses


def test_an_ideal_imu_is_announced_exactly() -> None:
    assert ImuParameters(ideal=True, calibration_error=True).wrong is None


@pytest.mark.slow
def test_the_true_calibration_stands_in_the_summary_alone(tmp_path: Any) -> None:
    path = tmp_path / "tiny.xml"
    path.write_text(WORLD)
    error = {"position": [0.0, 0.0, 0.25], "scale": [0.0625, 0, 0, 0, 0, 0]}
    drone: dict[str, Any] = {"name": "drone", "type": "Multirotor", "world": str(path)}
    drone |= {"imu": {"calibration_error": error}, "lidars": [{"name": "lidar", "channels": 2}]}
    table = {"run": {"name": "n", "duration": 0.1}, "nodes": [drone]}
    run = visnav.run(table, out=tmp_path / "run", quiet=True)
    assert set(run.summary["truth"]) == {"drone/imu"}
    truth = run.summary["truth"]["drone/imu"]
    assert truth["true"]["position"] == [0.0, 0.0, 0.0]
    assert truth["announced"]["position"] == [0.0, 0.0, 0.25]
    first = [truth[name]["gyroscope_matrix"][0] for name in ("announced", "true")]
    assert first == [1.0625, 1.0]
    said = run.summary["announcements"]
    (imu,) = (announcement for announcement in said if announcement["source"] == "drone/imu")
    assert imu["gyroscope_matrix"][0] == 1.0625
