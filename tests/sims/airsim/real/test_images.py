"""Images that the real clients decode are the run's own, to the byte."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.sims.airsim.real.environments import CLIENTS
from tests.sims.airsim.real.rig import SERVER, WORLD, flown

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
BOTH = pytest.mark.parametrize("client", CLIENTS)
KEEP = "[[nodes]]\nname = 'keep'\ntype = 'tests.sims.airsim.real.keep:Keep'\n"
WIDTH, HEIGHT = 64, 48
SKY = 65504.0


@BOTH
def test_images_are_the_runs_own(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, nodes=KEEP, settings='time = "paused"') as rig:
        found = rig.script(client, "images", str(tmp_path))
        rig.end()

    def own(kind: str) -> Any:
        return np.load(rig.folder / f"{kind}-{stamp}.npy")

    (stamp,) = set(found["stamps"])
    assert found["sizes"] == [[WIDTH, HEIGHT]] * 9
    pixels, png, planar, along_ray, shown, disparity, objects, normals, infrared = (
        np.load(tmp_path / f"{number}.npy") for number in range(9)
    )
    rgb, depth, segmentation = own("Image"), own("DepthImage"), own("SegmentationImage")
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) > 20, "there is something to see"

    in_order = pixels if client == "cosysairsim" else pixels[..., ::-1]
    np.testing.assert_array_equal(in_order, rgb)
    np.testing.assert_array_equal(png[..., 2::-1], rgb)  # OpenCV reads blue first
    assert np.all(png[..., 3] == 255)

    sky = np.isinf(depth)
    assert 0.05 < sky.mean() < 0.9
    np.testing.assert_array_equal(planar[~sky], depth[~sky])
    assert np.all(planar[sky] == SKY)
    focal = WIDTH / 2  # of 90 degrees
    columns = (np.arange(WIDTH) - (WIDTH - 1) / 2) / focal
    rows = (np.arange(HEIGHT)[:, None] - (HEIGHT - 1) / 2) / focal
    ray = depth * np.sqrt(1 + columns**2 + rows**2)
    np.testing.assert_allclose(along_ray[~sky], ray[~sky], atol=1e-3)
    np.testing.assert_allclose(shown, np.minimum(depth / 100, 1.0), atol=1e-5)
    np.testing.assert_allclose(disparity, np.minimum(0.125 / depth, 1.0), atol=1e-5)

    kinds = np.unique(segmentation)
    colours = [objects[segmentation == kind].reshape(-1, 3) for kind in kinds]
    greys = [infrared[segmentation == kind].ravel() for kind in kinds]
    assert len(kinds) >= 4
    assert all(len(np.unique(each, axis=0)) == 1 for each in [*colours, *greys])
    assert len({tuple(each[0].tolist()) for each in colours}) == len(kinds)
    floor = normals[-1, WIDTH // 2]  # upwards: red and green in the middle, no blue
    assert sorted(floor.tolist()) == pytest.approx([0, 127, 127], abs=2)

    assert all(pose == found["poses"][0] for pose in found["poses"])
    east, down = found["vehicle"][1:]
    assert found["poses"][0][:3] == pytest.approx([0.46, east, down], abs=1e-4)
    assert found["fov"] == pytest.approx(90.0)
    assert found["png"] > 100


@BOTH
def test_a_camera_is_put_where_a_script_says(client: str, tmp_path: Path) -> None:
    """In computer-vision mode the images after a pose are taken from it."""
    camera = "[[nodes]]\nname = 'camera'\ntype = 'FreeCamera'\nworld = {}\n"
    world = tmp_path / "small.xml"
    world.write_text(WORLD)
    free = camera.format(f"'{world}'") + "rate = 20\n"
    text = f"[run]\nname = 'free'\nspeed = 1.0\nduration = '300s'\n{free}{SERVER}"
    with flown(tmp_path, text=text.format(settings="")) as rig:
        found = rig.script(client, "computer_vision", str(tmp_path))
        rig.end()
    for each, x in zip(found, (0.0, 1.0, 2.0), strict=True):
        assert each["pose"] == pytest.approx([x, 0.5, -1.0], abs=1e-4)
        assert each["image"] == pytest.approx([x, x], abs=1e-4), "of the pose that was set"
        assert each["depth"] == pytest.approx(8.9 - x, abs=1e-3), "the wall is there"
