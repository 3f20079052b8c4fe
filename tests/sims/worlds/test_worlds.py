"""What the built-in worlds promise: names, clearance, collisions, sizes, texture everywhere."""

from __future__ import annotations

import itertools
import math
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
from sims.worlds import CLEARANCE, TOURS, WORLDS, load_world
from tests.sims.cameras.scenes import CAMERAS, fresh, scene

ROOT = Path(__file__).parents[3]
REACH = {"hall": (7.0, 5.0), "yard": (12.0, 12.0)}
"""How far from the middle views are tried, metres north and east."""


class Probe:
    """Measures how far a place is from the nearest solid."""

    def __init__(self, name: str) -> None:
        world = fresh(name)
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


QUICK = ("hall", "corridor", "office")
"""Worlds whose textures are drawn in a moment, or in every run anyway."""

EACH = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WORLDS]


@pytest.fixture(params=EACH, scope="module")
def probe(request: pytest.FixtureRequest) -> tuple[str, Probe]:
    return request.param, Probe(request.param)


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
        world = next((n.get("world", "hall") for n in nodes if n["type"].startswith("sims.")), "")
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
    if name in ("office", "forest"):
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


def test_a_ball_comes_to_rest_on_the_floor_and_steps_are_cheap(probe: tuple[str, Probe]) -> None:
    """Solids hold a vehicle; they are few, and none touches another, so that steps cost little."""
    name, _ = probe
    world = fresh(name)
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
        image = renderer.render(0, qpos, ("wide",))["wide"].rgb
        assert image is not None
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found: Any = cv2.goodFeaturesToTrack(grey, 1000, 0.01, 7)
        corners = np.zeros((0, 2)) if found is None else found.reshape(-1, 2)
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
