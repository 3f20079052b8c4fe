"""Scripts of the real clients: they connect, fly, step time, read sensors and take images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extensions.airsim.tests.real.environments import CLIENTS
from extensions.airsim.tests.real.rig import CAMERA, SENSORS, SERVER, WORLD, flown

UNKNOWN = {
    "simGetMeshPositionVertexBuffers",
    "simListSceneObjectsTags",
    "simGetPhysicsRawKinematics",
    "simSetPhysicsRawKinematics",
}
"""Methods that are not there; nobody is known to call them."""

NOT_IN_ITS_WORLD = {"simSpawnObject"}
"""Refused for what is called with."""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # the first one installs its client


@pytest.mark.parametrize("client", CLIENTS)
def test_a_real_client_connects_and_reads_errors(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone="") as rig:
        assert rig.script(client, "handshake") == {"ping": True, "vehicles": ["drone"]}
        report = rig.script(client, "errors")
        rig.end()
    unknown, arity, vehicle, sensor, camera, control = report["refused"]
    assert unknown == "rpclib: server could not find function 'simNonsense' with argument count 1."
    assert arity.endswith("with an invalid number of arguments. Expected: 1, got: 0")
    assert "Vehicle API for 'nobody' is not available" in vehicle
    assert "No IMU with name nothing exist on vehicle" in sensor
    assert "nowhere" in camera
    assert "API control" in control or "enableApiControl" in control
    assert all("threw an exception" in message for message in (vehicle, sensor, camera, control))
    assert report["alive"]
    assert "takeoff" in rig.said, "what a future's join hides is logged"


@pytest.mark.parametrize("client", CLIENTS)
def test_every_method_of_a_client_is_answered(client: str, tmp_path: Path) -> None:
    """With as many arguments as it sends; what is refused is so with a reason."""
    with flown(tmp_path, drone=CAMERA + SENSORS) as rig:
        report = rig.script(client, "every_method", limit=300)
        rig.end()
    assert len(report["called"]) > 90
    without_reason = {
        name: error
        for name, error in report["errors"].items()
        if "not supported by visnav-runtime" not in error
    }
    assert without_reason.keys() <= UNKNOWN | NOT_IN_ITS_WORLD, without_reason


BOTH = pytest.mark.parametrize("client", CLIENTS)


def fly(client: str, script: str, folder: Path, *, drone: str = "", nodes: str = "") -> Any:
    """Fly a script in real time, and return what it returns."""
    with flown(folder, drone=drone, nodes=nodes) as rig:
        report = rig.script(client, script)
        rig.end()
    return report


@BOTH
def test_the_first_script_of_everybody_flies(client: str, tmp_path: Path) -> None:
    report = fly(client, "hello", tmp_path)
    assert report["start"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert report["landed"] == [0, 1, 0]
    assert report["up"] == pytest.approx([0.0, 0.0, -2.0], abs=0.5)
    assert report["there"] == pytest.approx([2.0, 1.0, -2.5], abs=0.5)
    assert report["yaw"] == pytest.approx(90.0, abs=6.0)
    assert report["back"] == pytest.approx([0.0, 0.0, -1.0], abs=0.6)
    assert report["down"][2] == pytest.approx(0.0, abs=0.05)


@BOTH
def test_a_velocity_goes_on_while_the_script_sleeps(client: str, tmp_path: Path) -> None:
    report = fly(client, "unjoined", tmp_path)
    assert report["moving"] > 0.3
    assert report["still"] < 0.1, "it holds its place once the duration is over"
    assert report["distance"] == pytest.approx(1.5, abs=0.6)


@BOTH
def test_a_newer_task_ends_the_older_one(client: str, tmp_path: Path) -> None:
    report = fly(client, "superseded", tmp_path)
    assert (report["far"], report["near"]) == (False, True)
    far, near = report["ended"]
    assert far < 0.3
    assert near > 0.45


@BOTH
def test_two_drones_fly_at_a_time(client: str, tmp_path: Path) -> None:
    other = "[[nodes]]\nname = 'another'\ntype = 'Multirotor'\nposition = [0, 3]\n"
    report = fly(client, "two", tmp_path, nodes=other)
    assert report["names"] == ["another", "drone"]
    assert report["where"]["another"] == pytest.approx([1.0, 0.0, -2.0], abs=0.6)
    assert report["where"]["drone"] == pytest.approx([2.0, 0.0, -2.0], abs=0.6)


@BOTH
def test_a_drone_flies_again_after_a_reset(client: str, tmp_path: Path) -> None:
    report = fly(client, "again", tmp_path)
    assert report["reset"] == pytest.approx([0.0, 0.0, 0.0], abs=0.05)
    assert report["control"] is False
    assert report["up"] == pytest.approx([0.0, 0.0, -2.0], abs=0.5)


@BOTH
def test_a_collision_is_told_once(client: str, tmp_path: Path) -> None:
    report = fly(client, "collision", tmp_path)
    assert not report["before"]
    assert report["has"] == [True, False], "reading it clears it"
    assert report["object"] == "crate"
    assert report["normal"] == pytest.approx([-1.0, 0.0, 0.0], abs=0.2)


@BOTH
def test_clients_of_several_threads_poll_at_a_time(client: str, tmp_path: Path) -> None:
    assert fly(client, "threads", tmp_path) == [20, 20, 20, 20]


@pytest.mark.parametrize("client", CLIENTS)
def test_a_script_steps_time(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone="") as rig:
        report = rig.script(client, "stepped")
        rig.end()
    steps = np.diff(report["stamps"])
    assert np.all(steps == 250_000_000)
    assert report["paused"]
    assert report["where"][2] == pytest.approx(-2.0, abs=0.5)
    assert report["later"] == report["where"], "nothing moves while time stands"


@pytest.mark.parametrize(("time", "script"), [("paused", "stepped"), ("awaited", "hello")])
def test_equal_scripts_give_equal_runs(time: str, script: str, tmp_path: Path) -> None:
    digests, replies = set(), []
    for number, client in enumerate([*CLIENTS, "airsim"]):
        folder = tmp_path / str(number)
        folder.mkdir()
        settings = f'time = "{time}"'
        with flown(folder, drone="", settings=settings, speed='"max"') as rig:
            replies.append(rig.script(client, script))
            digests.add(rig.end()["digest"])
    assert replies[0] == replies[1] == replies[2]
    assert len(digests) == 1


@pytest.mark.parametrize("client", CLIENTS)
def test_sensors_are_read(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, drone=SENSORS) as rig:
        report = rig.script(client, "sensors")
        rig.end()
    assert report["imu"] == pytest.approx([0.0, 0.0, -9.807], abs=0.5)
    assert 0 <= report["state_stamp"] - report["imu_stamp"] < 20_000_000
    assert report["pressure"] == pytest.approx(report["environment"], abs=30.0)
    assert 0.2 < np.linalg.norm(report["field"]) < 0.7, "Gauss"
    assert report["fix"] == 3
    assert report["latitude"] == pytest.approx(report["home"], abs=1e-4)
    assert report["distance"] == pytest.approx(3.6, abs=0.3), "to the crate's side"
    assert report["points"] > 200
    assert report["lowest"] < 0.2, "the floor is below"


KEEP = "[[nodes]]\nname = 'keep'\ntype = 'extensions.airsim.tests.real.keep:Keep'\n"
WIDTH, HEIGHT = 64, 48
SKY = 65504.0


@BOTH
def test_images_are_the_runs_own(client: str, tmp_path: Path) -> None:
    with flown(tmp_path, nodes=KEEP, settings='time = "paused"') as rig:
        report = rig.script(client, "images", str(tmp_path))
        rig.end()

    def own(kind: str) -> Any:
        return np.load(rig.folder / f"{kind}-{stamp}.npy")

    (stamp,) = set(report["stamps"])
    assert report["sizes"] == [[WIDTH, HEIGHT]] * 9
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
    assert all(len(np.unique(view, axis=0)) == 1 for view in [*colours, *greys])
    assert len({tuple(view[0].tolist()) for view in colours}) == len(kinds)
    floor = normals[-1, WIDTH // 2]  # upwards: red and green in the middle, no blue
    assert sorted(floor.tolist()) == pytest.approx([0, 127, 127], abs=2)

    assert all(pose == report["poses"][0] for pose in report["poses"])
    east, down = report["vehicle"][1:]
    assert report["poses"][0][:3] == pytest.approx([0.46, east, down], abs=1e-4)
    assert report["fov"] == pytest.approx(90.0)
    assert report["png"] > 100


@BOTH
def test_a_camera_is_put_where_a_script_says(client: str, tmp_path: Path) -> None:
    """In computer-vision mode the images after a pose are taken from it."""
    camera = "[[nodes]]\nname = 'camera'\ntype = 'FreeCamera'\nworld = {}\n"
    world = tmp_path / "small.xml"
    world.write_text(WORLD)
    free = camera.format(f"'{world}'") + "rate = 20\n"
    text = f"[run]\nname = 'free'\nspeed = 1.0\nduration = '300s'\n{free}{SERVER}"
    with flown(tmp_path, text=text.format(settings="")) as rig:
        views = rig.script(client, "computer_vision", str(tmp_path))
        rig.end()
    for view, x in zip(views, (0.0, 1.0, 2.0), strict=True):
        assert view["pose"] == pytest.approx([x, 0.5, -1.0], abs=1e-4)
        assert view["image"] == pytest.approx([x, x], abs=1e-4), "of the pose that was set"
        assert view["depth"] == pytest.approx(8.9 - x, abs=1e-3), "the wall is there"
