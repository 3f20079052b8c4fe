"""Presets of real sensors: settings by name, for `imu`, `cameras`, `depth_sensor` and `lidars`.

Each figure has its source above it; *estimate* marks those that no source gives. Who adds a sensor
adds a row here: the listing of nodes, the schema and the tests read these tables. A preset is the
sensor, not its use: mounting, exposure times, latencies, and the rate of an IMU, which is its
driver's choice, are left to the file. The IMUs in flight (``adis16448_flight``) are an exception:
most of what such a sensor measures above 20 Hz is of the vehicle that it is bolted to.
"""

from __future__ import annotations

from math import radians
from typing import Any

Preset = dict[str, Any]

_G = 9.80665  # standard gravity, m/s²


def _imu(gyroscope: tuple[float, ...], accelerometer: tuple[float, ...]) -> Preset:
    names = ("noise_density", "random_walk", "turn_on_bias", "range", "resolution")
    both = {"gyroscope": gyroscope, "accelerometer": accelerometer}
    return {f"{one}_{n}": v for one, row in both.items() for n, v in zip(names, row, strict=True)}


IMUS = {
    # Noise: EuRoC data set, imu0/sensor.yaml. Else: Analog Devices ADIS16448 data sheet,
    # specifications at ±1000 °/s: repeatability of the bias (1 sigma), range, scale factor.
    "adis16448": _imu(
        (1.6968e-4, 1.9393e-5, radians(0.5), radians(1000), radians(0.04)),
        (2.0e-3, 3.0e-3, 0.02 * _G, 18 * _G, _G / 1200),
    ),
    # Bosch BST-BMI088-DS001, section 1.2, at ±2000 °/s and ±24 g; offsets (±1 °/s, ±20 mg) as 3
    # sigma. Random walks: estimate, as the same maker's BMI160 in TUM VI's imu_config.yaml.
    "bmi088": _imu(
        (radians(0.014), 2.2e-5, radians(1) / 3, radians(2000), radians(2000) / 32768),
        (175e-6 * _G, 8.6e-4, 0.02 * _G / 3, 24 * _G, 24 * _G / 32768),
    ),
    # InvenSense PS-MPU-9250A-01, sections 3.1 and 3.2, at ±2000 °/s and ±16 g; offsets (±5 °/s,
    # ±60 mg) as 3 sigma. Random walks: estimate.
    "mpu9250": _imu(
        (radians(0.01), 3e-5, radians(5) / 3, radians(2000), radians(2000) / 32768),
        (300e-6 * _G, 1e-3, 0.06 * _G / 3, 16 * _G, 16 * _G / 32768),
    ),
    # TDK InvenSense DS-000189, sections 3.1 and 3.2, at ±2000 °/s and ±16 g; offsets (±5 °/s,
    # ±50 mg) as 3 sigma. Random walks: estimate.
    "icm20948": _imu(
        (radians(0.015), 3e-5, radians(5) / 3, radians(2000), radians(2000) / 32768),
        (230e-6 * _G, 1e-3, 0.05 * _G / 3, 16 * _G, 16 * _G / 32768),
    ),
}


def _in_flight(
    name: str, turn_on: tuple[float, float], instability: tuple[float, float] = (0.0, 0.0)
) -> Preset:
    """Return an IMU bolted to a flying multirotor of a metre or less.

    Vibration: as measured of the ADIS16448 of EuRoC's vehicle in flight (MH_01, V1_02, V2_03):
    above 20 Hz 0.5 to 1.0 m/s² and 0.022 to 0.038 rad/s, floors of 0.044 to 0.088 m/s²/√Hz and
    2e-3 rad/s/√Hz (of one side), a tone at 91 Hz; at hover, which needs 0.45 of the full thrust. A
    second tone, at 28 Hz, is not of the rotors, and is left out. Corners: estimates,
    so that next to nothing is left below 5 Hz, as of MH_01: there the sensor differs from the
    vehicle's true motion by 0.05 m/s² and 5e-4 rad/s, of which its own noise is the most.
    """
    return {
        **IMUS[name],
        "gyroscope_turn_on_bias": turn_on[0],
        "accelerometer_turn_on_bias": turn_on[1],
        "gyroscope_bias_instability": instability[0],
        "accelerometer_bias_instability": instability[1],
        "vibration": {
            "amplitude": 0.6,
            "angular_amplitude": 0.03,
            "rotor_speed": 135.0,
            "density": 0.10,
            "angular_density": 3.9e-3,
            "corner": 80.0,
            "lower_corner": 16.0,
        },
    }


IMUS |= {
    # Biases at the start: those of EuRoC's, (-0.002, 0.021, 0.077) rad/s and (-0.025, 0.137, 0.059)
    # m/s², as one standard deviation. In-run stability: the data sheet, 14.5 °/h and 0.25 mg.
    "adis16448_flight": _in_flight(
        "adis16448", (0.046, 0.087), (radians(14.5) / 3600, 0.25e-3 * _G)
    ),
    # Biases at the start: as at rest; in-run stability: Bosch, 2 °/h; of the accelerometer and of
    # the others: estimate, as of MEMS of that price.
    "bmi088_flight": _in_flight(
        "bmi088", (radians(1) / 3, 0.02 * _G / 3), (radians(2) / 3600, 1e-4 * _G)
    ),
    "mpu9250_flight": _in_flight(
        "mpu9250", (radians(5) / 3, 0.06 * _G / 3), (radians(10) / 3600, 2e-4 * _G)
    ),
    "icm20948_flight": _in_flight(
        "icm20948", (radians(5) / 3, 0.05 * _G / 3), (radians(10) / 3600, 2e-4 * _G)
    ),
}

DEPTH_SENSORS: dict[str, Preset] = {
    # Intel D400 series data sheet (337029): baseline, least depth at 848 × 480, range of some 10 m.
    # Intel, "Tuning depth cameras for best performance": RMS error of disparities. Their step:
    # estimate. The projector gives texture to walls.
    "realsense_d435i": {
        "model": "stereo",
        "baseline": 0.05,
        "disparity_step": 1 / 32,
        "disparity_noise": 0.08,
        "min_depth": 0.195,
        "min_contrast": 0.0,
    }
}


def _camera(kinds: tuple[str, ...], width: int, height: int, rate: float, **more: Any) -> Preset:
    return {"images": kinds, "width": width, "height": height, "rate": rate, "noise": 2.0, **more}


def _lens(model: str, *coefficients: float) -> Preset:
    return {"model": model, "coefficients": coefficients}


CAMERAS = {
    # The left imager and its depth: Intel D400 series data sheet (337029): horizontal field of view
    # of depth, global shutter; 848 × 480 as Intel's tuning guide recommends.
    "realsense_d435i": _camera(
        ("grey", "depth"), 848, 480, 30.0, fov=87.0, depth_sensor=DEPTH_SENSORS["realsense_d435i"]
    ),
    # HD720 at 30 Hz, rectified as Stereolabs' SDK gives it. Data sheet: baseline, 2.12 mm lens,
    # 2 µm pixels, binned 2 × 2. Stereolabs' support pages: 25.6 µs a row.
    "zed2": _camera(
        ("rgb",), 1280, 720, 30.0, fov=100.7, readout=720 * 25.6e-6, stereo={"baseline": 0.12}
    ),
    # EuRoC data set, cam0/sensor.yaml and, of the right one, cam1/sensor.yaml. Global shutter.
    "euroc_mt9v034": _camera(
        *(("grey",), 752, 480, 20.0),
        intrinsics=(458.654, 457.296, 367.215, 248.375),
        lens=_lens("plumb_bob", -0.28340811, 0.07395907, 0.00019359, 1.76187114e-5),
    ),
    "euroc_mt9v034_right": _camera(
        *(("grey",), 752, 480, 20.0),
        intrinsics=(457.587, 456.134, 379.999, 255.238),
        lens=_lens("plumb_bob", -0.28368365, 0.07451284, -0.00010473, -3.5559e-5),
    ),
    # TUM VI data set, calibration of 512 × 512, camchain.yaml, cam0. Global shutter.
    "tum_vi": _camera(
        *(("grey",), 512, 512, 20.0),
        intrinsics=(190.97847715, 190.97330705, 254.93170606, 256.89744290),
        lens=_lens("equidistant", 0.00348238940, 0.00071503485, -0.00205323614, 0.00020293674),
    ),
}


def _lidar(
    channels: int, columns: int, elevations: tuple[float, float], reach: tuple[float, float],
    noise: float, **more: Any,
) -> Preset:  # fmt: skip
    """Return a lidar of 10 turns a second, with its least and greatest range."""
    names = ("rate", "channels", "columns", "elevations", "min_range", "max_range", "noise")
    row = (10.0, channels, columns, elevations, *reach, noise)
    return {**dict(zip(names, row, strict=True)), **more}


LIDARS = {
    # Velodyne VLP-16 data sheet (63-9229) and manual (63-9243): 55.296 µs for 16 rays, typical
    # accuracy; estimate: the least range.
    "vlp16": _lidar(16, 1808, (-15.0, 15.0), (0.5, 100.0), 0.03),
    # Ouster OS1 data sheet, generation 1: field of view of 64 channels, range of a target of 80 %,
    # repeatability at a signal-to-noise ratio of 100.
    "os1_64": _lidar(64, 1024, (-16.6, 16.6), (0.8, 120.0), 0.03),
    # Livox Mid-360 user manual, specifications: 200,000 points a second of 4 rays at a time, random
    # error of the range at 10 m, range of a target of 80 %. The rosette is that of two prisms here.
    "mid360": _lidar(
        4, 5000, (-7.0, 52.0), (0.1, 70.0), 0.02, pattern="solid_state", azimuths=(-180.0, 180.0)
    ),
}
