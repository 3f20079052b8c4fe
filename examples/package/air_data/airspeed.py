"""An airspeed sensor: its event, its announcement, its settings and its model."""

import numpy as np

from events import Event, SensorAnnouncement
from events.base import Category, check
from events.frames import cross, multiply, rotate, rotate_inverse
from events.sensors import SensorKind
from sims.sensors.sensor import NonNegative, Sensor, SensorSpec, Truth


class Airspeed(Event, category=Category.SENSOR):
    """Speed of the air along the sensor's x axis, as a pitot tube measures it.

    Attributes:
        frame_id: Frame of the sensor.
        airspeed: Metres per second, not negative.
    """

    frame_id: str = "base_link"
    airspeed: float

    def __post_init__(self) -> None:
        check(self, (self.airspeed, 0.0, 0.0))


class AirspeedAnnouncement(SensorAnnouncement):
    """An airspeed sensor; its measurements are sent as `Airspeed`.

    Attributes:
        noise: Standard deviation of the white noise, metres per second.
    """

    noise: float


class AirspeedSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an airspeed sensor.

    Attributes:
        noise: Standard deviation of the white noise, metres per second.
    """

    noise: NonNegative = 0.2


class AirspeedSensor(Sensor[AirspeedSpec]):
    """Speed of the body through the air, at the sensor's place."""

    kind = SensorKind(
        name="airspeed",
        event=Airspeed,
        announcement=AirspeedAnnouncement,
        group="airspeeds",
        fields={"airspeed": "m/s"},
        plots={"airspeed": "airspeed"},
    )
    spec_type = AirspeedSpec
    meaning = "The airspeed sensor; none if it is not set."

    def measure(self, truth: Truth) -> Airspeed:
        """Return the next airspeed."""
        spec = self.spec
        lever = rotate(truth.orientation, cross(truth.angular_velocity, spec.position))
        x, y, z = (np.subtract(truth.velocity, truth.wind) + lever).tolist()
        ahead = rotate_inverse(multiply(truth.orientation, spec.rotation), (x, y, z))[0]
        noise = spec.noise * float(self.random.standard_normal())
        return Airspeed(
            stamp=truth.stamp,
            source=self.source,
            frame_id=self.source,
            airspeed=max(ahead + noise, 0.0),
        )
