"""Set-points and commands for a vehicle, and the vehicle's events.

The newest set-point wins, whatever its kind. World frame NED, body frame FRD, SI units; see
`events.geometry`.
"""

from __future__ import annotations

from events.base import Category, Event, Quaternion, Vector3, check, check_pose


class Command(Event, category=Category.CONTROL):
    """Base of the commands, each sent once.

    Attributes:
        vehicle: Name of the vehicle; empty for the only one.
    """

    vehicle: str = ""

    def __post_init__(self) -> None:
        check(self)


class Setpoint(Event, category=Category.CONTROL):
    """Base of the set-points, sent repeatedly; only the newest counts.

    Attributes:
        vehicle: Name of the vehicle; empty for the only one.
    """

    vehicle: str = ""

    def __post_init__(self) -> None:
        check(self)


class Arm(Command):
    """Let the motors turn."""


class Disarm(Command):
    """Stop the motors."""


class Takeoff(Command):
    """Arm if need be, climb straight up and hover.

    Attributes:
        altitude: Metres above the point of take-off.
    """

    altitude: float = 1.5

    def __post_init__(self) -> None:
        check(self, (self.altitude, 0.0, 0.0))


class Land(Command):
    """Go straight down, and disarm when the ground is felt."""


class Hover(Command):
    """Stop and hold the position."""


class Teleport(Command):
    """Move to a pose at once, as no real vehicle can; a flying vehicle holds its place.

    Attributes:
        position: Metres in ``map``.
        orientation: Rotation from body to ``map``.
        linear_velocity: Metres per second in ``map``.
        angular_velocity: Radians per second in the body frame.
    """

    position: Vector3
    orientation: Quaternion
    linear_velocity: Vector3 = (0.0, 0.0, 0.0)
    angular_velocity: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, self.linear_velocity, self.angular_velocity)


class Reset(Command):
    """Return to the start: initial pose, disarmed, sensors restarted; time goes on."""


class PositionSetpoint(Setpoint):
    """Go to a position; velocity and acceleration are feed-forward along a path.

    Attributes:
        position: Metres in ``map``.
        velocity: Metres per second in ``map``, expected at that place.
        acceleration: Metres per second squared in ``map``, expected at that place.
        yaw: Heading in radians, clockwise from north seen from above.
        yaw_rate: Radians per second, expected at that place.
    """

    position: Vector3
    velocity: Vector3 = (0.0, 0.0, 0.0)
    acceleration: Vector3 = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __post_init__(self) -> None:
        turn = (self.yaw, self.yaw_rate, 0.0)
        check(self, self.position, self.velocity, self.acceleration, turn)


class PoseSetpoint(Setpoint):
    """Go to a pose; for vehicles free to take any attitude, such as a free camera.

    Attributes:
        position: Metres in ``map``.
        orientation: Rotation from body to ``map``.
    """

    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)


class VelocitySetpoint(Setpoint):
    """Move at a speed.

    Attributes:
        frame_id: ``map``, or ``heading``: x along the vehicle's heading, y to its right, z down.
        velocity: Metres per second in that frame.
        yaw_rate: Radians per second, clockwise seen from above.
    """

    frame_id: str = "map"
    velocity: Vector3
    yaw_rate: float = 0.0

    def __post_init__(self) -> None:
        check(self, self.velocity, (self.yaw_rate, 0.0, 0.0))


class AttitudeSetpoint(Setpoint):
    """Hold an attitude at a thrust.

    Attributes:
        orientation: Rotation from body to ``map``.
        thrust: 0 to 1 of what all motors can give together.
    """

    orientation: Quaternion
    thrust: float

    def __post_init__(self) -> None:
        check_pose(self, (self.thrust, 0.0, 0.0), self.orientation)


class BodyRateSetpoint(Setpoint):
    """Turn at given rates at a thrust.

    Attributes:
        angular_velocity: Radians per second in the body frame.
        thrust: 0 to 1 of what all motors can give together.
    """

    angular_velocity: Vector3
    thrust: float

    def __post_init__(self) -> None:
        check(self, self.angular_velocity, (self.thrust, 0.0, 0.0))


class MotorSetpoint(Setpoint):
    """Drive each motor by itself; nothing keeps the vehicle upright.

    Attributes:
        motor1: 0 to 1 of the greatest thrust of the vehicle's first motor, and so on. Beyond, it
            is taken as the nearer end. Our multirotor's are front right, rear left, front left,
            rear right.
        motor2: Of the second.
        motor3: Of the third.
        motor4: Of the fourth.
    """

    motor1: float
    motor2: float
    motor3: float
    motor4: float

    def __post_init__(self) -> None:
        check(self, (self.motor1, self.motor2, self.motor3), (self.motor4, 0.0, 0.0))


class PlannedPose(Event, category=Category.CONTROL):
    """Where a pilot means the vehicle to be at `stamp`; for the record, not an order.

    Attributes:
        vehicle: Name of the vehicle; empty for the only one.
        frame_id: Parent frame.
        position: Metres in the parent frame.
        yaw: Heading in radians, clockwise from north seen from above.
    """

    vehicle: str = ""
    frame_id: str = "map"
    position: Vector3
    yaw: float

    def __post_init__(self) -> None:
        check(self, self.position, (self.yaw, 0.0, 0.0))


class VehicleEvent(Event, category=Category.VEHICLE):
    """Base of all events of a vehicle."""

    def __post_init__(self) -> None:
        check(self)


class Armed(VehicleEvent):
    """The motors may turn."""


class Disarmed(VehicleEvent):
    """The motors are stopped."""


class TakenOff(VehicleEvent):
    """The vehicle has reached its commanded take-off altitude."""


class Landed(VehicleEvent):
    """The vehicle stands on the ground."""


class Collision(VehicleEvent):
    """The vehicle touched something; sent once when the contact begins.

    Attributes:
        other: Name of what it touched.
        position: Point of contact, metres in ``map``.
        normal: Unit vector in ``map``, from the other towards the vehicle.
        speed: Closing speed along the normal, metres per second.
    """

    other: str
    position: Vector3
    normal: Vector3
    speed: float

    def __post_init__(self) -> None:
        check(self, self.position, self.normal, (self.speed, 0.0, 0.0))
