"""The settings of a vehicle's sensors."""

from __future__ import annotations

from sims.sensors.barometer import BarometerSpec
from sims.sensors.gnss import GnssSpec
from sims.sensors.imu import ImuParameters
from sims.sensors.lidar import LidarSpec
from sims.sensors.magnetometer import MagnetometerSpec
from sims.sensors.range_finder import RangeFinderSpec
from sims.simulator import Rate, SimulatorConfig


class SensorsConfig(SimulatorConfig):
    """Settings of a vehicle's sensors.

    Attributes:
        imu_rate: Rate of the IMU and of the ground truth (`odometry`), Hz. The ground truth is also
            sent at each exposure.
        imu: Noise of the IMU.
        barometer: The barometer; none if it is not set. ``{}`` is one with all its defaults.
        gnss: The satellite receiver; none if it is not set.
        magnetometer: The magnetometer; none if it is not set.
        range_finders: The range finders.
        lidars: The lidars.
    """

    imu_rate: Rate = 200
    imu: ImuParameters = ImuParameters()
    barometer: BarometerSpec | None = None
    gnss: GnssSpec | None = None
    magnetometer: MagnetometerSpec | None = None
    range_finders: tuple[RangeFinderSpec, ...] = ()
    lidars: tuple[LidarSpec, ...] = ()

    def __post_init__(self) -> None:
        names = {"imu", "barometer", "gnss", "magnetometer"}
        for field in ("cameras", "range_finders", "lidars"):
            for spec in getattr(self, field):
                if spec.name in names:
                    raise ValueError(
                        f"{field}: {spec.name}: expected a name of its own, found that of "
                        "another sensor"
                    )
                names.add(spec.name)
