"""What the built-in worlds promise: names, clearance, collisions, sizes, texture everywhere.

Each hard world is hard in its own way, moves as it says, and costs little more to draw.

Worlds are found by name or path; what is wrong is said.
"""

from __future__ import annotations

import itertools
import math
import pickle
import statistics
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from msgspec import convert

from events.frames import from_rpy
from nodes.pilots import FigureEight
from sims.cameras import CameraRenderer, model_to_bytes, pose_to_qpos
from sims.worlds import CLEARANCE, TOURS, WORLDS, WorldError, load_scene, load_world
from tests.sims.cameras.scenes import CAMERAS, Scene, frames_of, fresh, scene

ROOT = Path(__file__).parents[3]
REACH = {"hall": (7.0, 5.0), "yard": (12.0, 12.0)}
"""How far from the middle views are tried, metres north and east."""


class Probe:
    """Measures how far a place is from the nearest solid."""

    def __init__(self, name: str) -> None:
        world = load_world(name, bare=True)
        body = world.worldbody.add_body(name="probe", mocap=True)
        body.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0])
        self.model: Any = world.compile()
        self.data = mujoco.MjData(self.model)
        self.geom = self.model.geom("probe").id
        self.mocap = int(self.model.body("probe").mocapid[0])
        solid = np.flatnonzero(self.model.geom_contype)
        self.solids = [int(geom) for geom in solid if geom != self.geom]
        mujoco.mj_kinematics(self.model, self.data)

    def distance(self, place: tuple[float, float, float], limit: float) -> float:
        x, y, z = place
        self.data.mocap_pos[self.mocap] = (x, -y, -z)
        mujoco.mj_kinematics(self.model, self.data)
        return float(
            min(
                mujoco.mj_geomDistance(self.model, self.data, self.geom, solid, limit, None)
                for solid in self.solids
            )
        )


QUICK = ("hall", "corridor", "office", "mocap")
"""Worlds whose textures are drawn in a moment, or in every run anyway."""

EACH = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WORLDS]


@pytest.fixture(params=EACH, scope="module")
def probe(request: pytest.FixtureRequest) -> tuple[str, Probe]:
    return request.param, Probe(request.param)


@pytest.mark.slow
def test_the_tour_is_clear(probe: tuple[str, Probe]) -> None:
    """Along each leg, and from the last point to the first, nothing is nearer than promised."""
    name, measure = probe
    points = np.array(TOURS[name])
    for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
        count = math.ceil(float(np.linalg.norm(end - start)) / 0.15)
        for share in np.linspace(0.0, 1.0, count):
            place = tuple((start + (end - start) * share).tolist())
            assert measure.distance(place, 2.0) >= CLEARANCE + 0.001, place


def test_the_examples_fly_clear(probe: tuple[str, Probe]) -> None:
    """No example's path touches anything, or comes so near that a gust would."""
    name, measure = probe
    for file in sorted((ROOT / "examples").glob("*.toml")):
        nodes = tomllib.loads(file.read_text(encoding="utf-8"))["nodes"]
        world = next((node["world"] for node in nodes if "world" in node), "hall")
        paths = [np.array(n["waypoints"]) for n in nodes if "waypoints" in n and world == name]
        eights = [n["figure_eight"] for n in nodes if "figure_eight" in n and world == name]
        paths += [convert(eight, FigureEight).places() for eight in eights]
        for start, end in itertools.chain(*(itertools.pairwise(path) for path in paths)):
            for share in np.linspace(0.0, 1.0, math.ceil(np.linalg.norm(end - start) / 0.3)):
                place = tuple((start + (end - start) * share).tolist())
                assert measure.distance(place, 2.0) >= 0.5, (file.name, place)


def test_the_tour_is_a_tour(probe: tuple[str, Probe]) -> None:
    """50 to 60 m long, 1.2 to 2.2 m high; most with turns both ways, some through two arches."""
    name, measure = probe
    points = np.array(TOURS[name])
    assert -points[:, 2].max() >= 1.2
    assert -points[:, 2].min() <= 2.2
    legs = np.roll(points, -1, axis=0) - points
    assert 50.0 <= np.linalg.norm(legs, axis=1).sum() <= 60.0
    heading = np.arctan2(legs[:, 1], legs[:, 0])
    turns = np.degrees((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
    assert turns.min() < -30.0
    if name == "corridor":  # once round the block
        return
    assert turns.max() > 30.0
    if name in ("office", "forest", "field", "mocap"):
        return
    passed = set()
    for start, leg in zip(points, legs, strict=True):
        for share in np.linspace(0.0, 1.0, 60):
            up = (start + leg * share) * (1.0, -1.0, -1.0)
            geom = np.zeros(1, np.int32)
            mujoco.mj_ray(
                measure.model, measure.data, up, np.array([0.0, 0.0, 1.0]),
                np.array([0, 0, 0, 1, 0, 0], np.uint8), True, -1, geom, None,
            )  # fmt: skip
            if geom[0] >= 0:
                passed.add(measure.model.geom(int(geom[0])).name.split("/")[0])
    assert len({over for over in passed if "arch" in over or "portal" in over}) == 2


def test_everything_has_a_name_and_only_solids_collide(probe: tuple[str, Probe]) -> None:
    """Geoms have names; looks meet nothing, and each solid that is meant to be seen has one."""
    _, measure = probe
    model = measure.model
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    assert all(names)
    for geom, name in enumerate(names):
        look = model.geom_group[geom] == 0 and geom != measure.geom
        assert bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) == (not look), name
        if name.endswith(".look"):
            assert name.removesuffix(".look") in names


@pytest.mark.slow
def test_a_ball_comes_to_rest_on_the_floor_and_steps_are_cheap(probe: tuple[str, Probe]) -> None:
    """Solids hold a vehicle; they are few, and none touches another, so that steps cost little."""
    name, _ = probe
    world = load_world(name, bare=True)
    ball = world.worldbody.add_body(name="ball", pos=[0, 0, 1.0])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=1.0)
    world.option.timestep = 0.001
    model = world.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    assert data.ncon == 0
    assert np.count_nonzero(model.geom_contype | model.geom_conaffinity) <= 150
    mujoco.mj_step(model, data, 3000)
    touched = {model.geom(int(geom)).name for geom in data.contact.geom.ravel()}
    assert touched & {"floor", "ground"}
    assert data.qpos[2] == pytest.approx(0.1, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH)
def test_sizes_are_modest(name: str) -> None:
    """The model with all its textures stays below 40 MB."""
    assert len(model_to_bytes(fresh(name).compile())) < 40e6


@pytest.mark.slow
def test_a_seed_decides_the_looks_and_not_the_place() -> None:
    """Same seed, same model to the byte; another seed, other textures, the same walls."""
    one, again, other = (load_world("hall", seed).compile() for seed in (1, 1, 2))
    assert model_to_bytes(one) == model_to_bytes(again)
    assert not np.array_equal(one.tex_data, other.tex_data)
    for wall in ("wall_north", "pillar_0", "brick_arch/left", "crate_3"):
        np.testing.assert_array_equal(one.geom(wall).pos, other.geom(wall).pos)
        np.testing.assert_array_equal(one.geom(wall).size, other.geom(wall).size)


def views(name: str, measure: Probe) -> Iterator[tuple[tuple[float, float, float], float]]:
    """Places on a grid at 1 to 2.5 m, no nearer than 0.7 m to anything, and headings."""
    north, east = REACH[name]
    step = 2.0 if name == "hall" else 4.0
    number = 0
    for x in np.arange(-north, north + 0.1, step):
        for y in np.arange(-east, east + 0.1, step):
            for quarter in range(4):
                number += 1
                place = (float(x), float(y), -(1.0, 1.75, 2.5)[number % 3])
                if measure.distance(place, 0.8) >= 0.7:
                    yield place, math.radians(90.0 * quarter + 31.0 * (number % 5))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hall", "yard"])
def test_there_are_corners_everywhere(name: str) -> None:
    """95 % of views have 200 good corners, in 12 of 16 parts of the image."""
    measure = Probe(name)
    built = scene(name)
    renderer = CameraRenderer(built.packed, CAMERAS, built.prefix, seed=0)
    good = []
    for place, heading in views(name, measure):
        qpos = pose_to_qpos(place, from_rpy(0.0, 0.0, heading))
        image = frames_of(renderer, 0, qpos, ("wide",))["wide"].rgb
        assert image is not None
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points: Any = cv2.goodFeaturesToTrack(grey, 1000, 0.01, 7)
        corners = np.zeros((0, 2)) if points is None else points.reshape(-1, 2)
        parts = {(int(x) // 128, int(y) // 128) for x, y in corners}
        good.append(len(corners) >= 200 and len(parts) >= 12)
    renderer.close()
    assert len(good) > 100
    assert np.mean(good) >= 0.95


def test_what_mujoco_warns_of_goes_to_the_log_and_to_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    file = tmp_path / "world.xml"
    file.write_text(
        """<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".1"/></body>
        </worldbody><actuator><motor joint="j"/></actuator></mujoco>"""
    )
    model = load_world(file).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = float("nan")
    mujoco.mj_step(model, data)
    assert "CTRL at ACTUATOR 0" in caplog.text
    assert not list(here.iterdir())


HARD = ("corridor", "office", "night", "forest")


@pytest.mark.slow
def test_the_field_shows_corners_wherever_one_flies() -> None:
    """100 in each view of its whole square near the ground, 500 in each from 10 m up."""
    built = scene("field")
    renderer = CameraRenderer(built.packed, CAMERAS, built.prefix, seed=0)
    random = np.random.default_rng(3)
    for number in range(120):
        north, east = random.uniform(-840.0, 840.0, 2).tolist()
        down, pitch = ((-2.0, 0.0), (-10.0, -0.5), (-25.0, -0.6), (-30.0, -1.5))[number % 4]
        turn = from_rpy(0.0, pitch, float(random.uniform(0.0, math.tau)))
        state = pose_to_qpos((north, east, down), turn)
        image = frames_of(renderer, 0, state, ("wide",))["wide"].rgb
        assert image is not None
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points: Any = cv2.goodFeaturesToTrack(grey, 1000, 0.01, 7)
        assert points is not None
        assert len(points) >= (100 if number % 4 == 0 else 500), (north, east, down)
    renderer.close()


def test_a_start_in_the_field_is_clear_wherever_scripts_go_first() -> None:
    """12 m about the start, and MAVSDK's examples: a long climb to the west, places far up."""
    measure = Probe("field")
    for away in (3.0, 7.0, 11.0):
        for angle in np.linspace(0.0, math.tau, 16, endpoint=False).tolist():
            place = (away * math.cos(angle), away * math.sin(angle), -0.5)
            assert measure.distance(place, 1.0) >= 0.4, place
    for share in np.linspace(0.0, 1.0, 200).tolist():
        place = (-15.1 * share, -191.3 * share, -0.5 - 19.5 * share)
        assert measure.distance(place, 2.0) >= 0.49, place
    for place in ((33.0, -44.0, -25.0), (553.0, -207.0, -30.0)):
        assert measure.distance(place, 20.0) >= 8.0, place


def places(name: str, count: int) -> list[tuple[Any, float]]:
    """Places on a world's tour, and the direction of flight there."""
    points = np.array(TOURS[name])
    poses = []
    for share in np.arange(count) / count * len(points):
        start, end = points[int(share)], points[(int(share) + 1) % len(points)]
        way = end - start
        place = start + (share % 1.0) * way
        poses.append((place, math.atan2(way[1], way[0])))
    return poses


def qpos(built: Scene, place: Any, heading: float) -> Any:
    pose = pose_to_qpos(tuple(place.tolist()), from_rpy(0.0, 0.0, heading))
    assert len(pose) == built.model.nq
    return pose


def greys(name: str, views: list[tuple[Any, float]]) -> list[Any]:
    built = scene(name)
    renderer = CameraRenderer(built.packed, CAMERAS, built.prefix, seed=0)
    images = []
    for place, heading in views:
        frame = frames_of(renderer, 0, qpos(built, place, heading), ("wide",))["wide"]
        assert frame.rgb is not None
        images.append(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY))
    renderer.close()
    return images


def corners(image: Any) -> int:
    return len(cv2.FastFeatureDetector.create(20).detect(image))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_opposite_places_of_the_corridor_look_alike() -> None:
    """From the other side of the block the image is the same to 2 grey levels, but for bins."""
    views = [(place, heading) for place, heading in places("corridor", 12)]
    other = [(np.array([-p[0], -7.8 - p[1], p[2]]), heading + math.pi) for p, heading in views]
    for image, twin in zip(greys("corridor", views), greys("corridor", other), strict=True):
        assert np.abs(image.astype(int) - twin).mean() < 4.0
        assert image.std() > 20.0


def test_the_middle_of_the_motion_capture_room_is_free() -> None:
    """Nothing from 0.3 to 3.2 m up within 2.6 m of the middle, something within 3.4 m."""
    for radius, free in ((2.6, True), (3.4, False)):
        world = load_world("mocap", bare=True)
        world.worldbody.add_geom(
            name="middle", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[radius, 1.45, 0],
            pos=[0.0, 0.0, 1.75],
        )  # fmt: skip
        model: Any = world.compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        middle = model.geom("middle").id
        solids = [int(k) for k in np.flatnonzero(model.geom_contype) if k != middle]
        near = [
            model.geom(solid).name
            for solid in solids
            if mujoco.mj_geomDistance(model, data, middle, solid, 1.0, None) <= 0.0
        ]
        assert (not near) == free, near


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_motion_capture_room_is_between_office_and_hall() -> None:
    """Five times the office's strong corners, fewer than the hall's; walls brighter than cloth."""
    images = {n: greys(n, places(n, 12)) for n in ("hall", "office", "mocap")}
    count = {n: statistics.median(corners(image) for image in images[n]) for n in images}
    assert 5 * count["office"] < count["mocap"] < 0.8 * count["hall"]
    spread = {n: statistics.median(float(image.std()) for image in images[n]) for n in images}
    assert spread["mocap"] > 1.3 * spread["hall"]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_office_shows_few_corners_and_the_night_is_dark() -> None:
    """Against hall and yard: a sixth of the corners, a fifth of the light."""
    images = {n: greys(n, places(n, 12)) for n in ("hall", "office", "yard", "night")}
    count = {n: statistics.median(corners(image) for image in images[n]) for n in images}
    assert count["office"] < count["hall"] / 6
    light = {n: statistics.median(float(image.mean()) for image in images[n]) for n in images}
    assert light["night"] < light["yard"] / 5
    assert max(int(image.max()) for image in images["night"]) > 200


def test_leaves_and_shadows_move_as_a_pure_function_of_time() -> None:
    """The same second gives the same place, whatever was before; nothing strays or is touched."""
    built = load_scene("forest", bare=True)
    model: Any = built.spec.compile()
    data, again = mujoco.MjData(model), mujoco.MjData(model)
    motion = built.dynamics.motions[0]
    assert not motion.solid
    built.dynamics.apply(model, data, 7.0)
    built.dynamics.apply(model, again, 3.0)
    moved = np.abs(again.mocap_pos - data.mocap_pos).max(axis=1)
    assert (moved > 0.0005).all()
    pickle.loads(pickle.dumps(motion)).apply(model, again, 7.0)
    np.testing.assert_array_equal(again.mocap_pos, data.mocap_pos)
    for seconds in np.linspace(0.0, 60.0, 100):
        built.dynamics.apply(model, data, float(seconds))
        assert np.abs(data.mocap_pos).max() < 0.4
        assert not data.mocap_pos[-7:, 2].any(), "shadows stay on the ground"


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_they_cost_at_most_twice_as_much_as_the_others() -> None:
    """Processor time of colour and depth at 512 x 512, outdoors against the yard, else the hall."""
    built = {name: scene(name) for name in ("hall", "yard", "field", "mocap", *HARD)}
    renderers = {
        name: CameraRenderer(world.packed, CAMERAS, world.prefix, seed=0)
        for name, world in built.items()
    }
    times: dict[str, list[float]] = {name: [] for name in built}
    for number in range(16):
        for name, renderer in renderers.items():
            place, heading = places(name, 16)[number]
            state = qpos(built[name], place, heading)
            tries = []
            for _ in range(3):
                start = time.process_time()
                frames_of(renderer, number, state, ("wide",))
                tries.append(time.process_time() - start)
            times[name].append(min(tries))
    medians = {name: statistics.median(values) for name, values in times.items()}
    print({name: f"{1e3 * seconds:.1f} ms" for name, seconds in medians.items()})
    for name in HARD:
        usual = "yard" if name in ("night", "forest") else "hall"
        assert medians[name] < 2.0 * medians[usual], name
    assert medians["field"] < 1.2 * medians["yard"]
    assert medians["mocap"] < 1.2 * medians["hall"]
    for renderer in renderers.values():
        renderer.close()


def test_every_world_has_a_tour() -> None:
    """The tours' names are the worlds' names."""
    assert set(TOURS) == set(WORLDS)


def test_a_file_is_a_world(tmp_path: Path) -> None:
    """A user's MJCF loads by path, as text or as a Path."""
    file = tmp_path / "mine.xml"
    file.write_text("<mujoco><worldbody><geom name='g' size='1'/></worldbody></mujoco>")
    for place in (file, str(file)):
        spec = load_world(place)
        assert isinstance(spec, mujoco.MjSpec)
        assert spec.geom("g") is not None


def test_an_unknown_name_gets_near_ones_suggested() -> None:
    """The message has what was found, what there is and what may have been meant."""
    words = r'of corridor, field, forest.*found "hal"; did you mean hall\?'
    with pytest.raises(WorldError, match=words):
        load_world("hal")
    with pytest.raises(WorldError, match=r'found "moon"$'):
        load_world("moon")


def test_missing_and_broken_files_are_told_apart(tmp_path: Path) -> None:
    """Nothing there, a directory, no XML, and XML that doesn't compile."""
    with pytest.raises(WorldError, match=r"none\.xml: expected an MJCF file, found nothing"):
        load_world(tmp_path / "none.xml")
    with pytest.raises(WorldError, match="found a directory"):
        load_world(tmp_path)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    with pytest.raises(WorldError, match=r"broken\.xml: expected an MJCF file that compiles.*XML"):
        load_world(broken)
    broken.write_text("<mujoco><worldbody><geom type='mesh' mesh='x'/></worldbody></mujoco>")
    with pytest.raises(WorldError, match=r"broken\.xml: .*mesh"):
        load_world(str(broken))
