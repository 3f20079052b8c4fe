"""The command's calibrations of a finished run, and the data of a recorded one."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from events import Announcement
from nodes.calibration.export import export_calibration
from runtime.config.reading import parse
from runtime.json_values import plain
from runtime.run.execute import execute
from tests.nodes.calibration.samples import stereo

RECORDED = {
    "run": {"duration": "1s"},
    "nodes": [
        {"name": "recorder", "type": "McapRecorder"},
        {
            "name": "drone",
            "type": "Multirotor",
            "cameras": [{"name": "camera", "width": 32, "height": 24, "rate": 10}],
        },
    ],
}


def summary(run: Path, announced: tuple[Announcement, ...]) -> Path:
    """Write what an export needs of a run."""
    run.mkdir()
    found = [{"type": type(each).__name__, **plain(each, "test")} for each in announced]
    (run / "summary.json").write_bytes(msgspec.json.encode({"announcements": found}))
    return run


def test_files_come_from_the_summary_of_a_run(tmp_path: Path) -> None:
    rig = stereo()
    assert rig.imu is not None
    run = summary(tmp_path / "run", (*rig.cameras, rig.imu))
    written = export_calibration(run, "kalibr")
    assert [path.relative_to(run).as_posix() for path in written] == [
        "export/kalibr/camchain-imucam.yaml",
        "export/kalibr/imu.yaml",
    ]
    one = export_calibration(run, "vslamlab", tmp_path / "one", camera="drone/right")
    assert "rgb_1" not in one[0].read_text()
    with pytest.raises(ValueError, match="called drone/frnt, found drone/left"):
        export_calibration(run, "kalibr", camera="drone/frnt")


def test_a_run_without_a_summary_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"summary.json: expected the summary of a finished run"):
        export_calibration(tmp_path, "kalibr")
    (tmp_path / "summary.json").write_text(json.dumps({"announcements": [{"type": "CameraInfo"}]}))
    with pytest.raises(ValueError, match="expected a camera with rgb or grey images, found none"):
        export_calibration(tmp_path, "kalibr")


@pytest.mark.slow
def test_a_recorded_run_gives_vslam_lab_its_data(tmp_path: Path) -> None:
    execute(parse(RECORDED, "test"), tmp_path)
    names = [path.name for path in export_calibration(tmp_path, "vslamlab", epoch=10**18)]
    assert names == ["calibration.yaml", "imu_0.csv", "groundtruth.csv", "rgb.csv"]
    folder = tmp_path / "export" / "vslamlab"
    rows = list(csv.DictReader((folder / "rgb.csv").read_text().splitlines()))
    assert list(rows[0]) == ["ts_rgb_0 (ns)", "path_rgb_0", "ts_depth_0 (ns)", "path_depth_0"]
    stamps = np.diff([int(row["ts_rgb_0 (ns)"]) for row in rows])
    assert len(rows) >= 8
    assert set(stamps.tolist()) == {100_000_000}
    assert int(rows[0]["ts_rgb_0 (ns)"]) >= 10**18
    colour: Any = cv2.imread(str(folder / rows[0]["path_rgb_0"]))
    assert colour.shape == (24, 32, 3)
    depth: Any = cv2.imread(str(folder / rows[0]["path_depth_0"]), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    imu = list(csv.reader((folder / "imu_0.csv").read_text().splitlines()))
    assert imu[0][:2] == ["ts (ns)", "wx (rad s^-1)"]
    assert float(imu[50][6]) == pytest.approx(-9.81, abs=0.2)
    truth = list(csv.reader((folder / "groundtruth.csv").read_text().splitlines()))
    assert len(truth) > 150
    assert float(truth[-1][3]) > 0.0  # up
    export_calibration(tmp_path, "vslamlab")  # again, over what is there
