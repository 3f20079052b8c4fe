"""Recordings, read back as AirSim's users do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.testing import NodeResult
from sims.airsim.server.recording import HEADER
from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script

SMALL = {"captures": [{"width": 32, "height": 16}, {"image_type": 1, "width": 32, "height": 16}]}
CAMERAS = [{"name": "eye", **SMALL}]
PNG = {"camera": "eye"}
PPM = {"camera": "eye", "compress": False}
PFM = {"camera": "eye", "image_type": 1, "pixels_as_float": True}


def read_back(out: Path) -> list[dict[str, str]]:
    """Return the rows of the only recording, split on tabs, as pandas does."""
    (table,) = out.glob("recording/*/airsim_rec.txt")
    assert re.fullmatch(r"\d{4}(-\d\d){5}(-\d+)?", table.parent.name)
    header, *rows = table.read_text().splitlines()
    assert header == HEADER
    names = header.split("\t")
    return [dict(zip(names, row.split("\t"), strict=True)) for row in rows]


def image_file(out: Path, name: str) -> Path:
    return next(out.glob(f"recording/*/images/{name}"))


def recorded(
    script: Any, world: str, out: Path, images: Any = (PNG,), vehicles: Any = None, **settings: Any
) -> NodeResult:
    return with_script(
        script,
        vehicles or [drone(world=world)],
        out=out,
        cameras=CAMERAS,
        recording={"images": images, **settings},
    )


def test_a_recording_is_read_back_as_airsims(tiny_world: str, tmp_path: Path) -> None:
    taken: list[Any] = []

    def script(airsim: Caller) -> None:
        assert airsim("isRecording") is False
        requests = [
            {"camera_name": "eye", "image_type": type_, "pixels_as_float": float_, "compress": png}
            for type_, float_, png in ((0, False, True), (0, False, False), (1, True, False))
        ]
        taken.extend(airsim("simGetImages", requests, "", False))
        airsim("startRecording")
        assert airsim("isRecording") is True
        airsim("simContinueForTime", 0.25)
        airsim("stopRecording")
        assert airsim("isRecording") is False
        airsim("simContinueForTime", 0.2)

    recorded(script, tiny_world, tmp_path, [PNG, PPM, PFM], interval="100ms")
    rows = read_back(tmp_path)
    assert [row["TimeStamp"] for row in rows] == ["0", "100", "200"]
    assert {row["VehicleName"] for row in rows} == {"drone"}
    assert float(rows[0]["POS_Z"]) == pytest.approx(0.0, abs=0.01)
    assert float(rows[0]["Q_W"]) == pytest.approx(1.0, abs=0.01)
    names = rows[0]["ImageFile"].split(";")
    assert names == ["img_drone_eye_0_0.png", "img_drone_eye_0_0.ppm", "img_drone_eye_1_0.pfm"]
    png, ppm, pfm = (image_file(tmp_path, name) for name in names)
    assert png.read_bytes() == taken[0]["image_data_uint8"]
    colours = np.frombuffer(taken[1]["image_data_uint8"], np.uint8).reshape(16, 32, 3)  # BGR
    np.testing.assert_array_equal(cv2.imread(str(ppm)), colours)
    header, size, scale, data = pfm.read_bytes().split(b"\n", 3)
    assert (header, size, scale) == (b"Pf", b"32 16", b"-1")
    np.testing.assert_array_equal(
        np.frombuffer(data, "<f4"), np.array(taken[2]["image_data_float"], np.float32)
    )


def test_each_row_has_the_pose_of_its_images_instant(tiny_world: str, tmp_path: Path) -> None:
    poses: dict[str, float] = {}

    def script(airsim: Caller) -> None:
        airsim("startRecording")
        for _ in range(10):
            pose = airsim("simGetVehiclePose", "")
            state = airsim("getMultirotorState", "")
            poses[str(state["timestamp"] // 10**6)] = pose["position"]["z_val"]
            airsim("simContinueForTime", 0.05)

    recorded(script, tiny_world, tmp_path, vehicles=[drone(world=tiny_world, height=2.0)])
    rows = {row["TimeStamp"]: float(row["POS_Z"]) for row in read_back(tmp_path)}
    assert len(rows) >= 10
    assert rows["450"] > 0.8  # it falls
    for stamp, height in poses.items():
        assert rows[stamp] == pytest.approx(height, abs=1e-6)


def test_a_vehicle_that_stands_is_left_out_if_asked(tiny_world: str, tmp_path: Path) -> None:
    vehicles = [
        drone("falls", world=tiny_world, height=3.0, position=(2.0, 0.0)),
        drone("stands", world=tiny_world),
    ]

    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.25)

    recorded(script, tiny_world, tmp_path, vehicles=vehicles, on_move=True, enabled=True)
    rows = read_back(tmp_path)
    assert [row["VehicleName"] for row in rows].count("falls") >= 5
    assert [row["VehicleName"] for row in rows].count("stands") < 5


def test_two_recordings_at_a_time_are_one_and_two_in_turn_are_two(
    tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        for _ in range(2):
            airsim("startRecording")
            airsim("startRecording")
            airsim("simContinueForTime", 0.01)
            airsim("stopRecording")
            airsim("stopRecording")

    recorded(script, tiny_world, tmp_path)
    assert len(list(tmp_path.glob("recording/*/airsim_rec.txt"))) == 2


def test_a_folder_that_is_lost_ends_the_recording_and_not_the_run(
    tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        airsim("startRecording")
        airsim("simContinueForTime", 0.05)
        (images,) = tmp_path.glob("recording/*/images")
        images.rename(tmp_path / "gone")
        airsim("simContinueForTime", 0.2)
        assert airsim("isRecording") is False
        with pytest.raises(RefusedError, match=r"recording has ended: .*No such file"):
            airsim("stopRecording")
        airsim("stopRecording")
        assert airsim("ping")

    recorded(script, tiny_world, tmp_path)


@pytest.mark.parametrize(
    ("images", "error"),
    [
        ([{"camera": "nobody"}], "found 'nobody'"),
        ([{"camera": "eye", "image_type": 9}], "images of type 9"),
    ],
)
def test_what_cannot_be_taken_ends_the_recording(
    images: Any, error: str, tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        airsim("startRecording")
        airsim("simContinueForTime", 0.1)
        with pytest.raises(RefusedError, match=error):
            airsim("stopRecording")

    recorded(script, tiny_world, tmp_path, images)


def test_without_a_folder_for_results_nothing_is_recorded(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        with pytest.raises(RefusedError, match="expected a run with a folder of results"):
            airsim("startRecording")
        assert airsim("isRecording") is False

    with_script(script, [drone(world=tiny_world)], recording={"enabled": True})


def test_a_folder_that_cannot_be_made_is_told(tiny_world: str, tmp_path: Path) -> None:
    (tmp_path / "recording").write_text("in the way")

    def script(airsim: Caller) -> None:
        with pytest.raises(RefusedError, match="the recording could not begin"):
            airsim("startRecording")

    recorded(script, tiny_world, tmp_path)
