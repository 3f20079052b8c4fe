"""Each hard world is hard in its own way, moves as it says, and costs little more to draw."""

from __future__ import annotations

import math
import pickle
import statistics
import time
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from sims.cameras import CameraRenderer, pose_to_qpos
from sims.worlds import TOURS, load_scene
from tests.sims.cameras.scenes import CAMERAS, Scene, scene

HARD = ("corridor", "office", "night", "forest")


def places(name: str, count: int) -> list[tuple[Any, float]]:
    """Places on a world's tour, and the direction of flight there."""
    points = np.array(TOURS[name])
    found = []
    for share in np.arange(count) / count * len(points):
        start, end = points[int(share)], points[(int(share) + 1) % len(points)]
        way = end - start
        place = start + (share % 1.0) * way
        found.append((place, math.atan2(way[1], way[0])))
    return found


def qpos(built: Scene, place: Any, heading: float) -> Any:
    pose = pose_to_qpos(tuple(place.tolist()), from_rpy(0.0, 0.0, heading))
    assert len(pose) == built.model.nq
    return pose


def greys(name: str, views: list[tuple[Any, float]]) -> list[Any]:
    built = scene(name)
    renderer = CameraRenderer(built.packed, CAMERAS, built.prefix, seed=0)
    images = []
    for place, heading in views:
        frame = renderer.render(0, qpos(built, place, heading), ("wide",))["wide"]
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
def test_they_cost_at_most_half_as_much_again_as_the_others() -> None:
    """Processor time of colour and depth at 512 x 512, outdoors against the yard, else the hall."""
    built = {name: scene(name) for name in ("hall", "yard", *HARD)}
    renderers = {
        name: CameraRenderer(each.packed, CAMERAS, each.prefix, seed=0)
        for name, each in built.items()
    }
    times: dict[str, list[float]] = {name: [] for name in built}
    for number in range(16):
        for name, renderer in renderers.items():
            place, heading = places(name, 16)[number]
            state = qpos(built[name], place, heading)
            tries = []
            for _ in range(3):
                start = time.process_time()
                renderer.render(number, state, ("wide",))
                tries.append(time.process_time() - start)
            times[name].append(min(tries))
    medians = {name: statistics.median(each) for name, each in times.items()}
    print({name: f"{1e3 * seconds:.1f} ms" for name, seconds in medians.items()})
    for name in HARD:
        usual = "yard" if name in ("night", "forest") else "hall"
        assert medians[name] < 1.5 * medians[usual], name
    for renderer in renderers.values():
        renderer.close()
