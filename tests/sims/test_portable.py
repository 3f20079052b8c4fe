"""A flight is the same on processors of other kinds: its inputs are, to the byte."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.portable import directions, gaussian, sines

ROOT = Path(__file__).parents[2]
FLIGHT = """
[run]
name = "flight"
clock = "lockstep"
duration = "{seconds}s"

[[nodes]]
name = "world"
type = "World"
world = "{world}"
wind = {{ velocity = [2.0, 0.5, 0.0], turbulence = "light" }}
bodies = [
    {{ name = "walker", kind = "person", waypoints = [[0.6, -1.4, 0.0], [1.0, 1.4, 0.0]] }},
]

[[nodes]]
name = "drone"
type = "Multirotor"
position = [-2.5, 0.0]
imu = {{ vibration = {{ amplitude = 2.0 }}, gyroscope_misalignment = 0.01 }}
barometer = {{}}
magnetometer = {{}}
gnss = {{}}
lidars = [{{ name = "lidar", rate = 5, channels = 16 }}]
range_finders = [{{ name = "below" }}]
cameras = [{{ name = "camera", width = 64, height = 48, rate = 5 }}]

[[nodes]]
name = "pilot"
type = "WaypointFollower"
{path}
"""
CARRIED = f"""
[run]
name = "carried"
clock = "lockstep"
duration = "6s"

[[nodes]]
name = "rig"
type = "Carried"
world = "hall"
trajectory = "{ROOT}/examples/motions/hall_tour.tum"
imu = {{ sampling = "mean" }}
gnss = {{}}
lidars = [{{ name = "lidar", rate = 5, channels = 16 }}]
range_finders = [{{ name = "below" }}]
cameras = [{{ name = "camera", width = 64, height = 48, rate = 5, readout = "10ms" }}]
"""
PATHS = {
    "waypoints": ("hall", "waypoints = [[-2.5, 0.0, -1.4], [2.0, 1.0, -1.5], [1.0, 2.0, -1.2]]"),
    "excitation": ("yard", "waypoints = [[-2.5, 0.0, -1.4]]\nexcitation = { duration = '5s' }"),
    "eight": ("hall", "figure_eight = { centre = [0.0, 0.0, -1.5] }"),
}


def inputs(file: Path, **environment: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "runtime", "run", str(file), "--quiet", "--out", "out"]
    subprocess.run(
        command, cwd=file.parent, env={**os.environ, **environment}, check=True, timeout=300
    )
    summary = json.loads((file.parent / "out/summary.json").read_text(encoding="utf-8"))
    assert len(summary["inputs"]) > 8
    return dict(summary["inputs"])


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="OpenBLAS's kernels are named by kind")
@pytest.mark.parametrize("path", PATHS)
def test_inputs_depend_on_no_width_of_vectors_and_no_kernels(path: str, tmp_path: Path) -> None:
    world, words = PATHS[path]
    assert_portable(FLIGHT.format(seconds=12, world=world, path=words), tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="OpenBLAS's kernels are named by kind")
def test_inputs_of_a_carried_body_depend_on_them_neither(tmp_path: Path) -> None:
    """Nor does the fit of its motion, or the place that is found for it."""
    assert_portable(CARRIED, tmp_path)


def assert_portable(config: str, folder: Path) -> None:
    """A run has the same inputs without what this processor can do beyond others."""
    file = folder / "flight.toml"
    file.write_text(config, encoding="utf-8")
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    here = simd.get("found", [])
    plain = inputs(file, NPY_DISABLE_CPU_FEATURES=" ".join(here), OPENBLAS_CORETYPE="Prescott")
    assert plain == inputs(file)


def test_the_functions_are_those_of_numpy() -> None:
    values = np.random.default_rng(1).normal(size=(200, 3))
    np.testing.assert_allclose(sines(values[:, 0]), np.sin(values[:, 0]), rtol=1e-14)
    angles = np.arctan2(values[:, 1], values[:, 0])
    np.testing.assert_allclose(directions(values), angles, rtol=1e-14)
    window = np.exp(-0.5 * (np.arange(-9, 10) / 2.5) ** 2)
    expected = np.convolve(values[:, 0], window / window.sum(), mode="valid")
    np.testing.assert_allclose(gaussian(values[:, 0], 2.5, 9), expected, rtol=1e-12, atol=1e-14)
