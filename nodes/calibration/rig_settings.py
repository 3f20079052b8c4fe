"""Kalibr's calibration as a configuration of ours: a vehicle that carries the rig.

Nothing in it says how the rig is mounted. Here its first camera looks straight ahead, and the IMU,
if there is one, is ahead of the vehicle's centre of mass, where else the first camera is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from events.frames import OPTICAL_TO_FRD
from events.geometry import Floats, pose_matrix
from nodes.kalibr import KalibrCamera, parse_chain
from runtime.errors import ConfigError

Table = dict[str, Any]

RATE = 20.0  # of the cameras, Hz: a calibration does not say it
AHEAD = 0.15  # metres from the vehicle's centre of mass
_PATH = [[0.0, 0.0, -1.5], [3.0, 0.2, -1.5], [3.0, -0.8, -1.6]]


def read(text: str, path: str, warn: Callable[[str], None], world: str = "hall") -> Table:
    """Return Kalibr's calibration as the content of an equivalent TOML file.

    Args:
        text: Of a chain, with or without that of an IMU's file after it.
        path: Its name, for messages.
        warn: Called with a line on each thing that the calibration does not say, or that is not
            honoured.

    Raises:
        ConfigError: It is no calibration of Kalibr's, or a camera or lens is not supported.
    """
    name = Path(path).name
    try:
        chain = parse_chain(text, name)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not chain.cameras:
        raise ConfigError(f"{name}: expected cameras (cam0, …), found an IMU alone")
    warn(f"{name}: it says no rate of the cameras: {RATE:g} Hz")
    drone: Table = {"name": "drone", "type": "Multirotor", "world": world}
    first = pose_matrix((AHEAD, 0.0, 0.0), OPTICAL_TO_FRD)
    imu, in_imu = np.eye(4), chain.cameras[0].in_imu
    if in_imu is not None:
        imu[:3, :3] = first[:3, :3] @ in_imu[:3, :3].T
        imu[0, 3] = AHEAD
        drone["imu"] = {"T_BS": _rows(imu)}
    if chain.imu is None:
        warn(f"{name}: it has no IMU's noise: that of the settings' defaults")
    else:
        noise = {
            field: getattr(chain.imu, field)
            for field in (
                "gyroscope_noise_density",
                "gyroscope_random_walk",
                "accelerometer_noise_density",
                "accelerometer_random_walk",
            )
        }
        rate = {"rate": chain.imu.rate} if chain.imu.rate else {}
        drone["imu"] = {**drone.get("imu", {}), **rate, **noise}
    drone["cameras"] = [
        _camera(c, first @ c.in_first if c.in_imu is None else imu @ c.in_imu, warn, name)
        for c in chain.cameras
    ]
    pilot = {"name": "pilot", "type": "WaypointFollower", "waypoints": _PATH}
    run = {"name": "rig", "clock": "lockstep", "seed": 1, "duration": "20s"}
    return {"run": run, "nodes": [drone, pilot]}


def _camera(camera: KalibrCamera, place: Floats, warn: Callable[[str], None], name: str) -> Table:
    info = camera.info
    table: Table = {
        "name": camera.name,
        "images": ["grey"],
        "width": info.width,
        "height": info.height,
        "intrinsics": [info.fx, info.fy, info.cx, info.cy],
        "rate": RATE,
        "T_BS": _rows(place),
    }
    if not info.is_pinhole:
        table["lens"] = {"model": info.distortion_model, "coefficients": list(info.distortion)}
    if camera.time_offset > 0.0:
        table["time_offset"] = f"{camera.time_offset!r}s"
    elif camera.time_offset < 0.0:
        warn(
            f"{name}: {camera.name}: timeshift_cam_imu of {-camera.time_offset:g} s is left out: "
            "stamps before the exposure are not simulated"
        )
    return table


def _rows(matrix: Floats) -> list[list[float]]:
    return (matrix + 0.0).tolist()  # type: ignore[no-any-return]
