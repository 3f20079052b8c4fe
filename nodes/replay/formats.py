"""Which reader a recording needs, by what lies there."""

from __future__ import annotations

from pathlib import Path

from nodes.replay.reader import Reader, ReplayError
from nodes.replay.recorded import Recorded, is_ours
from nodes.replay.settings import ReplayConfig


def open_reader(config: ReplayConfig, name: str) -> Reader:
    """Return a reader of a recording.

    Args:
        config: The replay's settings.
        name: Of the node.

    Raises:
        ReplayError: There is nothing there that can be read.
        MissingDependencyError: A library is not installed.
    """
    path = Path(config.file)
    vehicle = config.vehicle or name
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            from nodes.replay.rosbag import RosBag

            return RosBag(path, config.topics, vehicle)
        for folder in (path, path / "mav0"):
            if (folder / "cam0").is_dir() or (folder / "imu0").is_dir():
                from nodes.replay.euroc import Euroc

                return Euroc(folder, vehicle)
        if (path / "rgb.txt").is_file():
            from nodes.replay.tum_rgbd import TumRgbd

            return TumRgbd(path, vehicle, config.camera, config.depth_factor)
        raise ReplayError(
            f"{path}: expected a ROS 2 bag (metadata.yaml), or a data set of EuRoC's (mav0) or "
            "TUM's (rgb.txt), found a folder with none of these"
        )
    if not path.is_file():
        raise ReplayError(f"{path}: expected a recording, found no such file")
    if path.suffix not in {".db3", ".bag"} and is_ours(path):
        return Recorded(path)
    from nodes.replay.rosbag import RosBag

    return RosBag(path, config.topics, vehicle)
