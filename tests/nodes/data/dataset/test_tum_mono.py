"""TUM's monoVO layout: read back as DSO reads it, it undoes what the camera did to the light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from events import CameraInfo, Event, Image
from events.camera_info import srgb_light, vignette_map
from nodes.data.dataset import DatasetWriter
from nodes.trajectory_files import read_tum
from runtime.errors import NodeError
from runtime.testing import run_node
from tests.nodes.data.dataset.samples import camera, flight, image, png, pose

Floats = npt.NDArray[np.float64]
SIZE = (48, 64)
INFO = CameraInfo.from_fov(SIZE[1], SIZE[0], 1.4)


def record(out: Path, events: list[Event]) -> Path:
    run_node(DatasetWriter, inputs=events, out=out, config={"format": "tum_mono"})
    return out / "dataset"


def exposed(
    stamp: int, light: Floats, curve: Floats, exposure: float, gain: float, vignette: Floats
) -> list[Event]:
    """Return a pose and what a camera makes of light (per millisecond of exposure)."""
    seen = light * vignette * exposure * 1e3 * gain
    data = np.rint(np.interp(seen, curve, np.arange(256))).astype(np.uint8)
    made = Image(
        stamp=stamp,
        source="drone/front",
        frame_id="f",
        encoding="mono8",
        exposure_time=exposure,
        gain=gain,
        data=data,
    )
    return [pose(stamp), made]


@pytest.mark.parametrize("response", ["srgb", "gamma"])
def test_read_back_it_gives_the_light_of_the_scene(response: str, tmp_path: Path) -> None:
    """``G[image] / vignette / exposure``, which is DSO's photometric correction."""
    random = np.random.default_rng(1)
    light = random.uniform(0.05, 0.3, SIZE)
    levels = np.arange(256) / 255.0
    curve = srgb_light() if response == "srgb" else levels**1.8
    vignette = (-0.6, 0.2)
    announced = msgspec.structs.replace(
        camera(images=("grey",)),
        info=INFO,
        response=() if response == "srgb" else tuple((curve * 3.0 + 1.0).tolist()),
        vignette=vignette,
    )
    events: list[Event] = [announced]
    shutters = [(0.001, 1.0), (0.002, 1.0), (0.001, 2.5)]
    shares = vignette_map(INFO, vignette)
    for number, (exposure, gain) in enumerate(shutters):
        events += exposed(number * 30_000_000, light, curve, exposure, gain, shares)
    data = record(tmp_path, events)
    table = np.loadtxt(data / "pcalib.txt")
    assert table.shape == (256,)
    assert (np.diff(table) > 0).all()
    assert (table[0], table[-1]) == (0.0, 255.0)
    map_ = png(data / "vignette.png")
    assert map_.dtype == np.uint16
    assert map_.shape == SIZE
    times = np.loadtxt(data / "times.txt")
    for number, _ in enumerate(shutters):
        seen = png(data / "images" / f"{number:05d}.png")
        light_read = table[seen] / (map_ / map_.max()) / times[number, 2] / 255.0
        known = (seen > 20) & (seen < 254)
        np.testing.assert_allclose(light_read[known], light[known], rtol=0.06)
        assert known.mean() > 0.7
    np.testing.assert_allclose(times[:, 2], [1.0, 2.0, 2.5])
    assert times[:, 0].tolist() == [0, 1, 2]
    truth = read_tum(data / "groundtruthSync.txt")
    assert len(truth) == 3
    assert truth.positions[0].tolist() == [1.0, -2.0, 3.0]


def test_poses_of_other_stamps_are_in_no_file(tmp_path: Path) -> None:
    """As those of the first and last row of a rolling shutter."""
    events = flight(1)
    events[-1:-1] = [pose(5), pose(10)]
    data = record(tmp_path, events)
    rows = (data / "groundtruthSync.txt").read_text("utf-8").splitlines()
    assert [row.split()[0] for row in rows] == ["1577836800.000000000"]
    assert (data / "times.txt").read_text("utf-8") == "00000 1577836800.000000000\n"


def test_with_colours_the_camera_s_own_grey_images_are_taken(tmp_path: Path) -> None:
    both: list[Event] = [camera(images=("rgb", "grey"))]
    own = image(0, "drone/front/grey", grey=True)
    data = record(tmp_path, [*both, image(0), own])
    assert (png(data / "images" / "00000.png") == own.data).all()
    assert [p.name for p in (data / "images").iterdir()] == ["00000.png"]


@pytest.mark.parametrize(
    ("lens", "line", "third"),
    [
        ({}, "Pinhole 40.0 41.0 31.5 23.5 0.0", "none"),
        (
            {"distortion": (-0.2, 0.03, 0.001, -0.002, 0.0)},
            "RadTan 40.0 41.0 31.5 23.5 -0.2 0.03 0.001 -0.002",
            "crop",
        ),
        (
            {"distortion_model": "equidistant", "distortion": (0.01, 0.0, -0.001, 0.0)},
            "EquiDistant 40.0 41.0 31.5 23.5 0.01 0.0 -0.001 0.0",
            "crop",
        ),
    ],
)
def test_the_calibration_names_dso_s_models(
    lens: dict[str, Any], line: str, third: str, tmp_path: Path
) -> None:
    info = CameraInfo(width=64, height=48, fx=40.0, fy=41.0, cx=31.5, cy=23.5, **lens)
    data = record(tmp_path, [msgspec.structs.replace(camera(), info=info), image(0)])
    expected = [line, "64 48", third, "64 48"]
    assert (data / "camera.txt").read_text("utf-8").splitlines() == expected


def test_times_without_a_place_in_the_files_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rolling = msgspec.structs.replace(camera(), readout=0.02)
    record(tmp_path, [rolling, image(0)])
    assert "drone/front: no file of this layout says its readout, 0.02 s" in caplog.text


def test_a_lens_without_a_place_in_the_file_is_refused(tmp_path: Path) -> None:
    info = msgspec.structs.replace(INFO, distortion=(-0.2, 0.03, 0.0, 0.0, 0.01))
    with pytest.raises(NodeError, match="drone/front: expected distortion with four coefficients"):
        record(tmp_path, [msgspec.structs.replace(camera(), info=info), image(0)])


def test_an_earlier_data_set_makes_room(tmp_path: Path) -> None:
    record(tmp_path, flight(3))
    data = record(tmp_path, flight(1))
    assert len(list((data / "images").iterdir())) == 1
