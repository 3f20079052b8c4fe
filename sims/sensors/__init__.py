"""Sensors other than cameras: pure models, and what runs them for a vehicle's node.

A model is told the truth and returns what its sensor measures; it knows no clock and sends
nothing. `SensorSuite` runs all of a vehicle's models at their rates, and sends what they measure
when it is due.
"""

from sims.sensors.barometer import Barometer, BarometerSpec
from sims.sensors.gnss import Gnss, GnssSpec
from sims.sensors.imu import ImuModel, ImuNoise, ImuParameters, Vibration
from sims.sensors.lidar import Lidar, LidarSpec
from sims.sensors.magnetometer import Magnetometer, MagnetometerSpec
from sims.sensors.range_finder import RangeFinder, RangeFinderSpec
from sims.sensors.rays import Rays
from sims.sensors.scanner import Scanner
from sims.sensors.sensor import Sensor, SensorSpec, Truth
from sims.sensors.settings import SensorsConfig
from sims.sensors.suite import SensorOutputs, SensorSuite
from sims.sensors.vehicle_imu import VehicleImu, mount_imu

__all__ = [
    "Barometer",
    "BarometerSpec",
    "Gnss",
    "GnssSpec",
    "ImuModel",
    "ImuNoise",
    "ImuParameters",
    "Lidar",
    "LidarSpec",
    "Magnetometer",
    "MagnetometerSpec",
    "RangeFinder",
    "RangeFinderSpec",
    "Rays",
    "Scanner",
    "Sensor",
    "SensorOutputs",
    "SensorSpec",
    "SensorSuite",
    "SensorsConfig",
    "Truth",
    "VehicleImu",
    "Vibration",
    "mount_imu",
]
