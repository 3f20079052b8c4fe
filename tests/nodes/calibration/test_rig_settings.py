"""Kalibr's chain as a TOML file: the rig that flies is the one that was calibrated."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events.frames import OPTICAL_TO_FRD
from events.geometry import inverse, pose_matrix
from nodes.calibration.rig_settings import read
from nodes.kalibr import parse_chain
from runtime.config.model import Config
from runtime.config.reading import parse
from runtime.errors import ConfigError
from sims.cameras import camera_info, optical_in_body
from tests.nodes.calibration.kalibr_files import CHAIN, IMU


def rig(text: str) -> tuple[Config, list[str]]:
    warnings: list[str] = []
    return parse(read(text, "camchain.yaml", warnings.append), "rig"), warnings


def vehicle(config: Config) -> Any:
    return config.nodes[0].config


def test_cameras_and_imu_are_as_they_were_calibrated() -> None:
    """Lens, noise, and where each camera is on the IMU; the first one looks straight ahead."""
    config, _ = rig(CHAIN + IMU)
    drone, chain = vehicle(config), parse_chain(CHAIN, "chain")
    assert (drone.imu_rate, drone.imu.gyroscope_noise_density) == (200.0, 8e-5)
    imu = pose_matrix(drone.imu.position, drone.imu.rotation)
    assert drone.imu.position == (0.15, 0.0, 0.0)
    for spec, camera in zip(drone.cameras, chain.cameras, strict=True):
        assert camera_info(spec) == camera.info
        assert camera.in_imu is not None
        place = pose_matrix(*optical_in_body(spec))
        np.testing.assert_allclose(inverse(imu) @ place, camera.in_imu, atol=1e-9)
    ahead = pose_matrix((0, 0, 0), OPTICAL_TO_FRD)
    first = pose_matrix(*optical_in_body(drone.cameras[0]))
    np.testing.assert_allclose(first[:3, :3], ahead[:3, :3], atol=1e-9)


def test_a_chain_without_an_imu_is_cameras_alone() -> None:
    start, end = CHAIN.index("  T_cam_imu"), CHAIN.index("  cam_overlaps")
    second = CHAIN.index("  T_cam_imu", end)
    config, warnings = rig(CHAIN[:start] + CHAIN[end:second] + CHAIN[CHAIN.index("  T_cn_cnm1") :])
    left, right = vehicle(config).cameras
    assert left.position == (0.15, 0.0, 0.0)
    between = inverse(pose_matrix(*optical_in_body(left))) @ pose_matrix(*optical_in_body(right))
    assert between[:3, 3] == pytest.approx((0.1009, 0.0020, 0.0014), abs=3e-3)
    assert any("no IMU's noise" in line for line in warnings)


def test_what_it_does_not_say_or_cannot_be_had_is_a_warning() -> None:
    late = CHAIN.replace("cam1:\n", "  timeshift_cam_imu: -0.002\ncam1:\n")
    config, warnings = rig(f"{late}  timeshift_cam_imu: 0.004\n{IMU}")
    assert [float(spec.time_offset) for spec in vehicle(config).cameras] == [0.002, 0.0]
    rate, early = warnings
    assert rate == "camchain.yaml: it says no rate of the cameras: 20 Hz"
    assert early.startswith("camchain.yaml: cam1: timeshift_cam_imu of 0.004 s is left out")


@pytest.mark.parametrize(
    ("text", "wrong"),
    [(IMU, r"expected cameras \(cam0, …\), found an IMU alone"), ("a: 1", "expected Kalibr's cal")],
)
def test_what_is_no_chain_is_an_error(text: str, wrong: str) -> None:
    with pytest.raises(ConfigError, match=rf"camchain\.yaml: {wrong}"):
        rig(text)


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "runtime", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_import_prints_a_file_that_flies(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(CHAIN)
    (tmp_path / "imu.yaml").write_text(IMU)
    done = command(tmp_path, "import", "camchain.yaml", "imu.yaml", "--world", "yard")
    assert done.returncode == 0, done.stderr
    assert done.stderr == (
        "warning: camchain.yaml and imu.yaml: it says no rate of the cameras: 20 Hz\n"
    )
    head, comment = done.stdout.splitlines()[:2]
    assert head == "# Made from camchain.yaml and imu.yaml by `python -m runtime import`."
    assert comment.startswith("# camchain.yaml and imu.yaml: it says no rate")
    assert tomllib.loads(done.stdout)["nodes"][0]["world"] == "yard"
    (tmp_path / "rig.toml").write_text(done.stdout)
    done = command(tmp_path, "run", "rig.toml", "--set", "run.duration=1s")
    assert done.returncode == 0, done.stderr
    done = command(tmp_path, "import", "camchain.yaml", "rig.toml")
    assert done.returncode == 2
    assert "import: expected files of one kind (" in done.stderr
    assert "found camchain.yaml and rig.toml" in done.stderr
