"""Presets of real sensors: settings by name, for `imu`, `cameras`, `depth_sensor` and `lidars`.

Each figure has its source beside it; *estimate* marks those that no source gives. Who adds a sensor
adds a table here: the listing of nodes, the schema and the tests read these.

A preset is the sensor, not its use: where it is mounted, its rate if that is the driver's choice,
exposure times and latencies are left to the file.
"""

from __future__ import annotations

from math import radians
from typing import Any

Table = dict[str, dict[str, Any]]

_G = 9.80665
"""Standard gravity, m/s²."""

IMUS: Table = {
    # Noise: EuRoC data set, imu0/sensor.yaml. Else: Analog Devices ADIS16448 data sheet,
    # specifications at ±1000 °/s: repeatability of the bias (1 sigma), range, scale factor.
    "adis16448": {
        "gyroscope_noise_density": 1.6968e-4,
        "gyroscope_random_walk": 1.9393e-5,
        "accelerometer_noise_density": 2.0e-3,
        "accelerometer_random_walk": 3.0e-3,
        "gyroscope_turn_on_bias": radians(0.5),
        "accelerometer_turn_on_bias": 0.02 * _G,
        "gyroscope_range": radians(1000.0),
        "accelerometer_range": 18.0 * _G,
        "gyroscope_resolution": radians(0.04),
        "accelerometer_resolution": _G / 1200.0,
    },
    # Bosch BST-BMI088-DS001, section 1.2: output noise density, range and sensitivity at ±2000 °/s
    # and ±24 g; offsets (±1 °/s, ±20 mg) taken as 3 sigma.
    "bmi088": {
        "gyroscope_noise_density": radians(0.014),
        "gyroscope_random_walk": 2.2e-5,  # estimate: as the same maker's BMI160 in TUM VI
        "accelerometer_noise_density": 175e-6 * _G,
        "accelerometer_random_walk": 8.6e-4,  # estimate: as above
        "gyroscope_turn_on_bias": radians(1.0 / 3.0),
        "accelerometer_turn_on_bias": 0.02 * _G / 3.0,
        "gyroscope_range": radians(2000.0),
        "accelerometer_range": 24.0 * _G,
        "gyroscope_resolution": radians(2000.0 / 32768),
        "accelerometer_resolution": 24.0 * _G / 32768,
    },
    # InvenSense PS-MPU-9250A-01, sections 3.1 and 3.2, at ±2000 °/s and ±16 g; offsets (±5 °/s,
    # ±60 mg) taken as 3 sigma.
    "mpu9250": {
        "gyroscope_noise_density": radians(0.01),
        "gyroscope_random_walk": 3e-5,  # estimate
        "accelerometer_noise_density": 300e-6 * _G,
        "accelerometer_random_walk": 1e-3,  # estimate
        "gyroscope_turn_on_bias": radians(5.0 / 3.0),
        "accelerometer_turn_on_bias": 0.06 * _G / 3.0,
        "gyroscope_range": radians(2000.0),
        "accelerometer_range": 16.0 * _G,
        "gyroscope_resolution": radians(2000.0 / 32768),
        "accelerometer_resolution": 16.0 * _G / 32768,
    },
    # TDK InvenSense DS-000189, sections 3.1 and 3.2, at ±2000 °/s and ±16 g; offsets (±5 °/s,
    # ±50 mg) taken as 3 sigma.
    "icm20948": {
        "gyroscope_noise_density": radians(0.015),
        "gyroscope_random_walk": 3e-5,  # estimate
        "accelerometer_noise_density": 230e-6 * _G,
        "accelerometer_random_walk": 1e-3,  # estimate
        "gyroscope_turn_on_bias": radians(5.0 / 3.0),
        "accelerometer_turn_on_bias": 0.05 * _G / 3.0,
        "gyroscope_range": radians(2000.0),
        "accelerometer_range": 16.0 * _G,
        "gyroscope_resolution": radians(2000.0 / 32768),
        "accelerometer_resolution": 16.0 * _G / 32768,
    },
}

DEPTH_SENSORS: Table = {
    # Intel D400 series data sheet (337029): baseline, least depth at 848 × 480. Intel, "Best known
    # methods for tuning D400 cameras": RMS subpixel error. The projector gives texture to walls.
    "realsense_d435i": {
        "model": "stereo",
        "baseline": 0.05,
        "disparity_step": 1.0 / 32.0,  # Intel, "Projectors for D400": 5 bits below a pixel
        "disparity_noise": 0.08,
        "min_depth": 0.195,
        "max_depth": 10.0,  # data sheet: "about 10 m"
        "min_contrast": 0.0,
    },
}

_WVGA = {"images": ("grey",), "width": 752, "height": 480, "rate": 20.0, "noise": 2.0}

CAMERAS: Table = {
    # The left imager and its depth: Intel D400 series data sheet (337029): horizontal field of view
    # of depth 87°, global shutter; 848 × 480 as Intel's tuning guide recommends.
    "realsense_d435i": {
        "images": ("grey", "depth"),
        "width": 848,
        "height": 480,
        "fov": 87.0,
        "rate": 30.0,
        "noise": 2.0,  # estimate
        "depth_sensor": DEPTH_SENSORS["realsense_d435i"],
    },
    # HD720 at 30 Hz, rectified as Stereolabs' SDK gives it. Data sheet: baseline, 2.12 mm lens,
    # 2 µm pixels, binned 2 × 2. Stereolabs' support pages: 25.6 µs a row.
    "zed2": {
        "images": ("rgb",),
        "width": 1280,
        "height": 720,
        "fov": 100.7,
        "rate": 30.0,
        "readout": 720 * 25.6e-6,
        "noise": 2.0,  # estimate
        "stereo": {"baseline": 0.12},
    },
    # EuRoC data set, cam0/sensor.yaml: all but the noise (estimate). Global shutter.
    "euroc_mt9v034": {
        **_WVGA,
        "intrinsics": (458.654, 457.296, 367.215, 248.375),
        "lens": {
            "model": "plumb_bob",
            "coefficients": (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-5),
        },
    },
    # EuRoC data set, cam1/sensor.yaml: the right one of the pair.
    "euroc_mt9v034_right": {
        **_WVGA,
        "intrinsics": (457.587, 456.134, 379.999, 255.238),
        "lens": {
            "model": "plumb_bob",
            "coefficients": (-0.28368365, 0.07451284, -0.00010473, -3.5559e-5),
        },
    },
    # TUM VI data set, 512 × 512, camchain.yaml, cam0: all but the noise (estimate). Global shutter.
    "tum_vi": {
        "images": ("grey",),
        "width": 512,
        "height": 512,
        "intrinsics": (190.97847715, 190.97330705, 254.93170606, 256.89744290),
        "lens": {
            "model": "equidistant",
            "coefficients": (0.00348238940, 0.00071503485, -0.00205323614, 0.00020293674),
        },
        "rate": 20.0,
        "noise": 2.0,
    },
}

LIDARS: Table = {
    # Velodyne VLP-16 user manual (63-9243) and data sheet (63-9229): 55.296 µs for 16 rays, typical
    # accuracy ±3 cm.
    "vlp16": {
        "rate": 10.0,
        "channels": 16,
        "columns": 1808,
        "elevations": (-15.0, 15.0),
        "min_range": 0.5,  # estimate: the manual warns of what is nearer
        "max_range": 100.0,
        "noise": 0.03,
    },
    # Ouster OS1 data sheet, generation 1: field of view of the 64-channel model, range of a target
    # of 80 %, repeatability at a signal-to-noise ratio of 100.
    "os1_64": {
        "rate": 10.0,
        "channels": 64,
        "columns": 1024,
        "elevations": (-16.6, 16.6),
        "min_range": 0.8,
        "max_range": 120.0,
        "noise": 0.03,
    },
    # Livox Mid-360 user manual, specifications: 200,000 points a second of 4 rays at a time, random
    # error of the range at 10 m, range of a target of 80 %. Its rosette is that of two prisms here.
    "mid360": {
        "pattern": "solid_state",
        "rate": 10.0,
        "channels": 4,
        "columns": 5000,
        "azimuths": (-180.0, 180.0),
        "elevations": (-7.0, 52.0),
        "min_range": 0.1,
        "max_range": 70.0,
        "noise": 0.02,
    },
}
