"""The settings of a vehicle's sensors."""

from __future__ import annotations

from sims.sensors.barometer import BarometerSpec
from sims.sensors.imu import ImuParameters
from sims.simulator import Rate, SimulatorConfig


class SensorsConfig(SimulatorConfig):
    """Settings of a vehicle's sensors.

    Attributes:
        imu_rate: Rate of the IMU and of the ground truth (`odometry`), Hz. The ground truth is also
            sent at each exposure.
        imu: Noise of the IMU.
        barometer: The barometer; none if it is not set. ``{}`` is one with all its defaults.
    """

    imu_rate: Rate = 200
    imu: ImuParameters = ImuParameters()
    barometer: BarometerSpec | None = None
