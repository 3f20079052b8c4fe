"""Sensors other than cameras: pure models, and the suite for a vehicle's node.

A model makes measurements of the truth; it knows no clock and sends nothing, as `SensorSuite` does.
"""

from sims.sensors.imu import ImuModel, ImuNoise, ImuParameters
from sims.sensors.suite import SensorsConfig, SensorSuite, mount_imu

__all__ = ["ImuModel", "ImuNoise", "ImuParameters", "SensorSuite", "SensorsConfig", "mount_imu"]
