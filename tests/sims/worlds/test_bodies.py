"""What moves by itself: on its way, at its times, wherever it is asked for, and picklable."""

from __future__ import annotations

import math
import pickle
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.config.reading import convert
from runtime.errors import ConfigError
from sims.world import World, WorldConfig
from sims.worlds import Dynamics, Scene, load_world
from sims.worlds.bodies import BodyMotion, BodySpec, motion_of
from sims.worlds.dynamics import Path

WALK = ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 2.0, -0.5), (0.0, 2.0, 0.0))


def made(**config: Any) -> tuple[Any, Any, Dynamics]:
    """Return a model of an empty world with what the settings say, its data and its dynamics."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_light(name="lamp", diffuse=[0.8, 0.6, 0.4])
    dynamics = World.populate(Scene(spec), "world", convert(config, WorldConfig, "world"))
    model = spec.compile()
    return model, mujoco.MjData(model), dynamics


def body(**fields: Any) -> BodyMotion:
    spec = convert({"name": "b", "kind": "box"} | fields, BodySpec, "body")
    return motion_of(spec, "world/b")


@pytest.mark.slow
@given(speed=st.floats(0.2, 8.0), turns=st.integers(0, 3), loop=st.booleans())
def test_a_path_passes_its_places_at_its_times(speed: float, turns: int, loop: bool) -> None:
    motion = body(waypoints=WALK, speed=speed, loop=loop)
    assert motion.path is not None
    times = motion.path.times
    period = times[-1] if loop else 0.0
    for place, when in zip(WALK, times, strict=False):
        assert motion.pose(when + turns * period)[0] == pytest.approx(place, abs=1e-6)
    if not loop:
        assert motion.pose(times[-1] + 100.0)[0] == pytest.approx(WALK[-1], abs=1e-6)


PLACES = st.lists(
    st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.just(0.0)), min_size=2, max_size=6
)


@settings(max_examples=60, deadline=None)
@given(places=PLACES, loop=st.booleans(), seconds=st.floats(0.0, 100.0))
def test_it_moves_and_turns_without_jumps(
    places: list[tuple[float, float, float]], loop: bool, seconds: float
) -> None:
    distinct = [p for k, p in enumerate(places) if k == 0 or math.dist(p, places[k - 1]) > 0.2]
    if len(distinct) < 2 or (loop and math.dist(distinct[0], distinct[-1]) < 0.2):
        return
    path = body(waypoints=distinct, loop=loop, speed=1.0).path
    assert path is not None
    (before, yaw), (after, later) = path.at(seconds), path.at(seconds + 0.01)
    assert math.dist(before, after) < 0.2  # splines overshoot, but no body flies at 20 m/s
    assert abs(math.remainder(later - yaw, math.tau)) < 0.35


@pytest.mark.slow
@given(st.floats(0.0, 60.0))
def test_it_looks_where_it_goes(seconds: float) -> None:
    """Round a circle: within 3 degrees of its way, over the loop's end too."""
    angles = np.arange(0.0, math.tau, math.tau / 12)
    circle = [(4 * math.cos(a), 4 * math.sin(a), 0.0) for a in angles]
    path = CIRCLE.setdefault("path", body(waypoints=circle, speed=1.5).path)
    assert isinstance(path, Path)
    (x, y, _), (later_x, later_y, _) = path.at(seconds)[0], path.at(seconds + 1e-3)[0]
    way = math.atan2(later_y - y, later_x - x)
    assert abs(math.remainder(path.at(seconds)[1] - way, math.tau)) < math.radians(3)


CIRCLE: dict[str, Any] = {}


def test_a_door_opens_and_closes_without_overshooting() -> None:
    door = body(
        kind="door", waypoints=[(1, 2, 0)], heading=90, times=[0, 2, 3, 5], angles=[0, 80, 80, 0]
    )
    yaws = []
    for seconds in np.arange(0.0, 10.0, 0.05):
        place, (w, _, _, z) = door.pose(float(seconds))
        assert place == (1, 2, 0)
        yaws.append(math.degrees(2 * math.atan2(z, w)) - 90)
    assert min(yaws) == pytest.approx(0.0, abs=1e-6)
    assert max(yaws) == pytest.approx(80.0)
    assert yaws[40] == pytest.approx(80.0)
    assert yaws[:100] == pytest.approx(yaws[100:], abs=1e-6)
    assert np.abs(np.diff(yaws)).max() < 4.0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"times": [0, 1]}, r"bodies: b: times: expected 5, found 2"),
        ({"times": [0, 1, 1, 2, 3]}, r"bodies: b: times: expected rising ones, found \[0"),
        ({"angles": [0, 1]}, r"bodies: b: angles: expected some of a door"),
        ({"kind": "door"}, r"bodies: b: waypoints: expected one, a door's hinge, found 4"),
        ({"waypoints": [(0, 0, 0), (0, 0, 0)]}, r"bodies: b: waypoints: .* no two neighbours"),
        ({"kind": "dog"}, r'kind: .*found "dog"'),
        ({"speed": 0}, r"speed: .*0"),
        ({"wheels": 3}, r"wheels"),
    ],
)
def test_mistakes_are_named(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        body(**({"waypoints": WALK} | fields))


def test_all_copies_of_a_world_show_the_same_whatever_came_before() -> None:
    """As a renderer in another process: pickled, and asked for times in another order."""
    config = {
        "bodies": [{"name": "p", "kind": "person", "waypoints": WALK}],
        "lights": [{"name": "*", "times": [0, 10], "factors": [1, 0.2], "flicker": 0.5}],
        "fog": {"start": 1, "end": 20, "times": [0, 5], "factors": [0.1, 1]},
    }
    model, data, dynamics = made(**config)
    other, copy, _ = made(**config)
    again: Dynamics = pickle.loads(pickle.dumps(dynamics))

    def shown(model: Any, data: Any) -> tuple[Any, ...]:
        fog, head = model.vis.map, model.vis.headlight
        return (
            data.mocap_pos.tolist(),
            data.mocap_quat.tolist(),
            model.light_diffuse.tolist(),
            head.ambient.tolist(),
            (fog.fogstart, fog.fogend),
        )

    for seconds in (0.0, 3.3, 7.0):
        dynamics.apply(model, data, seconds)
        for earlier in (9.0, 1.0, seconds):
            again.apply(other, copy, earlier)
        assert shown(model, data) == shown(other, copy)
    assert shown(model, data)[2][0][0] < 0.8


def test_physics_is_told_of_what_can_be_touched_only() -> None:
    _, _, dynamics = made(
        bodies=[{"name": "p", "kind": "person", "waypoints": WALK}],
        lights=[{"name": "lamp"}],
        fog={},
    )
    assert [type(motion).__name__ for motion in dynamics.solid.motions] == ["BodyMotion"]
    assert dynamics.fog


def test_a_light_dims_turns_and_names_its_alternatives() -> None:
    config = {
        "name": "lamp",
        "times": [0, 10],
        "factors": [1, 0.5],
        "directions": [(0, 0, 1), (0, 1, 0)],
    }
    model, data, dynamics = made(lights=[config])
    dynamics.apply(model, data, 10.0)
    assert model.light_diffuse[0].tolist() == pytest.approx([0.4, 0.3, 0.2], abs=1e-6)
    assert model.light_dir[0].tolist() == pytest.approx([0, -1, 0])
    dynamics.apply(model, data, 0.0)
    assert model.light_dir[0].tolist() == pytest.approx([0, 0, -1])
    with pytest.raises(ValueError, match=r"one of lamp, headlight or .*did you mean 'lamp'"):
        made(lights=[{"name": "lam"}])


@given(st.floats(0.0, 1000.0))
def test_flicker_stays_within_its_share(seconds: float) -> None:
    _, _, dynamics = FLICKER
    strength = dynamics.motions[0].spec.strength(seconds)  # type: ignore[attr-defined]
    assert 0.7 - 1e-9 <= strength <= 1.0


FLICKER = made(lights=[{"name": "lamp", "flicker": 0.3}])


@pytest.mark.slow
def test_every_light_of_the_built_in_worlds_has_a_name() -> None:
    """Else nobody could change it."""
    for name in ("hall", "yard"):
        assert all(light.name for light in load_world(name, bare=True).lights)


def test_kinds_are_as_large_as_they_say() -> None:
    for kind, height in (("person", 1.76), ("car", 1.45), ("door", 2.05), ("box", 0.6)):
        extra = {"angles": [0, 0], "times": [0, 1]} if kind == "door" else {}
        spec = {"name": "b", "kind": kind, "waypoints": [(0, 0, 0)]} | extra
        model, data, _ = made(bodies=[spec])
        mujoco.mj_forward(model, data)
        tops = [
            data.geom_xpos[g, 2] + (data.geom_xmat[g].reshape(3, 3) @ model.geom_aabb[g, :3])[2]
            + np.abs(data.geom_xmat[g].reshape(3, 3)) [2] @ model.geom_aabb[g, 3:]
            for g in range(model.ngeom)
        ]  # fmt: skip
        assert max(tops) == pytest.approx(height, abs=0.05), kind
