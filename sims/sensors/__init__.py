"""Sensors other than cameras: pure models, and the suite for a vehicle's node.

A model is told the truth and returns what its sensor measures; it knows no clock and sends
nothing. `SensorSuite` runs all of a vehicle's models at their rates, and sends what they measure
when it is due.
"""

from sims.sensors.imu import ImuModel, ImuNoise, ImuParameters
from sims.sensors.suite import SensorsConfig, SensorSuite, mount_imu

__all__ = ["ImuModel", "ImuNoise", "ImuParameters", "SensorSuite", "SensorsConfig", "mount_imu"]
