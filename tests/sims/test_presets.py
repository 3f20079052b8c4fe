"""Presets of real sensors: each is valid, is overridden key by key, and is announced as it says."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from events import CameraAnnouncement, ImuAnnouncement, LidarAnnouncement
from events.geometry import pose_matrix
from runtime.config.model import Config, to_builtins
from runtime.config.parameters import toml
from runtime.config.reading import load, parse
from runtime.errors import ConfigError
from runtime.tools.describe import describe_settings
from runtime.tools.preflight import lint, of_nodes
from sims.cameras.spec import announcement
from sims.multirotor import MultirotorConfig
from sims.presets import CAMERAS, DEPTH_SENSORS, IMUS, LIDARS

ROOT = Path(__file__).parents[2]
KINDS = {"imu": IMUS, "cameras": CAMERAS, "lidars": LIDARS, "depth_sensor": DEPTH_SENSORS}
EACH = [(kind, name) for kind, table in KINDS.items() for name in table]


def read(text: str) -> Config:
    """Return a file with a vehicle whose settings are a text in TOML."""
    drone = {"name": "drone", "type": "Multirotor", **tomllib.loads(text)}
    return parse({"nodes": [drone]}, "test.toml")


def config_of(text: str) -> Any:
    return read(text).nodes[0].config


def settings(kind: str, name: str, more: str = "") -> Any:
    """Return the settings of a sensor made from a preset, and further keys in TOML."""
    if kind == "imu":
        return config_of(f'[imu]\npreset = "{name}"\n{more}').imu
    if kind == "depth_sensor":
        made = config_of(f'cameras = [{{ name = "x", depth_sensor = "{name}" }}]\n{more}')
        return made.cameras[0].depth_sensor
    return getattr(config_of(f'[[{kind}]]\nname = "x"\npreset = "{name}"\n{more}'), kind)[0]


def flat(table: Any) -> Any:
    """Return a table with lists for tuples, as TOML has them."""
    if isinstance(table, dict):
        return {key: flat(value) for key, value in table.items()}
    return [*map(flat, table)] if isinstance(table, list | tuple) else table


@pytest.mark.parametrize(("kind", "name"), EACH)
def test_a_preset_is_a_valid_sensor_with_its_figures(kind: str, name: str) -> None:
    """None of its figures is lost or repeats a default, and the results name them all."""
    made = settings(kind, name)
    for key, value in KINDS[kind][name].items():
        actual = getattr(made, key)
        expected = type(actual)(**value) if isinstance(value, dict) and key != "lens" else value
        if key == "lens":
            expected = (value["model"], value["coefficients"])
            actual = (actual.model, actual.coefficients)
        assert actual == expected, key
    assert made.preset is None


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_announces_the_figures_of_its_preset(name: str) -> None:
    figures, made = CAMERAS[name], settings("cameras", name)
    said = announcement(made, source="drone/x", prefix="", parent_frame_id="base_link")
    assert isinstance(said, CameraAnnouncement)
    assert (said.info.width, said.info.height) == (figures["width"], figures["height"])
    assert said.rate == figures["rate"]
    assert said.readout == pytest.approx(figures.get("readout", 0.0))
    if "intrinsics" in figures:
        info = said.info
        assert (info.fx, info.fy, info.cx, info.cy) == figures["intrinsics"]
        assert info.distortion[:4] == figures["lens"]["coefficients"]
    else:
        half = math.atan(figures["width"] / 2.0 / said.info.fx)
        assert math.degrees(2.0 * half) == pytest.approx(figures["fov"])


def test_the_rules_of_lint_object_to_no_preset() -> None:
    """Each rule sees the figures of the preset, as those of any other sensor."""
    cameras = "".join(f'[[cameras]]\nname = "{n}"\npreset = "{n}"\n' for n in CAMERAS)
    config = read(f'trigger = "imu"\nimu_rate = 600\nimu = "bmi088"\n{cameras}')
    said = [
        announcement(spec, source=f"drone/{spec.name}", prefix="", parent_frame_id="base_link")
        for spec in cast("MultirotorConfig", config.nodes[0].config).cameras
    ]
    assert {finding.rule for finding in lint(config, said)} <= {"no-end", "idle"}


def test_keys_beside_a_preset_override_it_at_any_depth() -> None:
    alone = settings("imu", "bmi088")
    made = settings("imu", "bmi088", "g_sensitivity = 1e-4\ngyroscope_turn_on_bias = 0.0")
    assert (made.g_sensitivity, made.gyroscope_turn_on_bias) == (1e-4, 0.0)
    assert made.accelerometer_range == alone.accelerometer_range
    near = settings("cameras", "realsense_d435i", "depth_sensor = { max_depth = 4.0 }")
    assert near.depth_sensor.max_depth == 4.0
    assert near.depth_sensor.baseline == DEPTH_SENSORS["realsense_d435i"]["baseline"]
    small = settings("cameras", "euroc_mt9v034", "width=376\nintrinsics=[229.0, 228.0, 183.4, 124]")
    assert (small.width, small.intrinsics[0]) == (376, 229.0)


def test_the_name_alone_is_enough_where_nothing_else_is_needed() -> None:
    assert config_of('imu = "mpu9250"').imu == settings("imu", "mpu9250")
    with pytest.raises(ConfigError, match=r"cameras\[0\]: expected a setting \"name\", found none"):
        config_of('cameras = ["zed2"]')


def test_an_imu_has_its_rate_among_its_own_settings_too() -> None:
    made = config_of('imu = { preset = "bmi088", rate = 400 }')
    assert made.imu_rate == made.imu.rate == 400
    assert config_of('imu = "bmi088"').imu_rate == 200
    with pytest.raises(ConfigError, match=r"imu\.rate: .* found 100 and 400 Hz"):
        config_of("imu_rate = 100\nimu = { rate = 400 }")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('imu = "bmi888"', r"\(drone\): imu\.preset: expected one of adis16448, .* mean 'bmi088'"),
        ('imu = { preset = "" }', r'imu\.preset: expected one of adis16448, .*, found ""'),
        ("imu = { preset = 3 }", r"imu\.preset: expected a text, found 3"),
        (
            '[[cameras]]\nname = "a"\n[[cameras]]\nname = "b"\npreset = "zed"',
            r"cameras\[1\]\.preset: expected one of .*, found \"zed\" \(did you mean 'zed2'",
        ),
        (
            '[[cameras]]\nname = "a"\ndepth_sensor = "kinect"',
            r"cameras\[0\]\.depth_sensor\.preset: expected one of realsense_d435i, found",
        ),
        ('[[cameras]]\nname="a"\npreset="tum_vi"\nwidth=256', r"expected intrinsics beside width"),
        ('[[cameras]]\nname="a"\npreset="tum_vi"\nfov=90', r"expected intrinsics beside fov"),
        ('imu = { preset = "bmi088", gyro = 1 }', r"found unknown key 'gyro'"),
    ],
)
def test_a_mistake_is_told_with_the_names(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        config_of(text)


def test_settings_of_the_results_are_those_of_the_run_without_a_preset() -> None:
    """So a run repeats from them, also where a preset has changed since."""
    config = read(
        '[imu]\npreset = "adis16448"\nrate = 400\n[[cameras]]\nname = "z"\npreset = "zed2"\n'
    )
    table = to_builtins(config)
    assert "preset" not in toml(flat(table["nodes"]))
    assert parse(table, "config.toml") == config


def test_the_names_are_listed_with_the_settings() -> None:
    listed = {setting.name: setting for setting in describe_settings(MultirotorConfig)}
    for kind in ("imu", "cameras", "lidars"):
        (preset,) = [setting for setting in listed[kind].settings if setting.name == "preset"]
        assert preset.type == " or ".join(f'"{name}"' for name in KINDS[kind])


@pytest.mark.slow
def test_the_rig_of_euroc_is_the_one_of_its_files() -> None:
    """Its announcements give T_BS of cam0 and cam1, and the noise of imu0/sensor.yaml."""
    findings = of_nodes(load(ROOT / "examples" / "euroc_rig.toml"))
    assert findings.errors == []
    imu = next(a for a in findings.announcements if isinstance(a, ImuAnnouncement))
    body = pose_matrix(imu.position, imu.orientation)
    for name, rows in {
        "cam0": [
            [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
            [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
            [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        ],
        "cam1": [
            [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
            [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
            [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
        ],
    }.items():
        (camera,) = [a for a in findings.announcements if a.source == f"drone/{name}"]
        assert isinstance(camera, CameraAnnouncement)
        across = np.linalg.inv(body) @ pose_matrix(camera.position, camera.orientation)
        assert across[:3] == pytest.approx(np.array(rows), abs=1e-9)
    assert imu.gyroscope_noise_density == 1.6968e-4
    assert not any(isinstance(a, LidarAnnouncement) for a in findings.announcements)
