"""The whole cascade behind one door: a checked set-point in, four motor commands out.

Whether the vehicle may fly at all is not asked here; that is `autopilot`'s business.
"""

from __future__ import annotations

from events import (
    AttitudeSetpoint,
    BodyRateSetpoint,
    MotorSetpoint,
    PositionSetpoint,
    Quaternion,
    Vector3,
    VelocitySetpoint,
)
from events.frames import normalize, yaw_of
from sims.vehicle.attitude import AttitudeController, BodyRateController
from sims.vehicle.gains import Gains, Limits
from sims.vehicle.mixer import Mixer
from sims.vehicle.model import VehicleParameters
from sims.vehicle.physics import State
from sims.vehicle.position import PositionController

Motors = tuple[float, float, float, float]
"""Motor commands, 0 to 1 of each motor's thrust."""


class Controller:
    """Follows the newest set-point, whatever its kind.

    Position and velocity set-points go through the whole cascade and its limits. Attitude and
    body-rate set-points enter further down: of the limits only those on body rates hold for them,
    and the thrust is theirs. Motor set-points pass all of it by.
    """

    def __init__(
        self,
        parameters: VehicleParameters,
        gains: Gains | None = None,
        limits: Limits | None = None,
    ) -> None:
        gains = gains or Gains()
        limits = limits or Limits()
        self.position = PositionController(parameters, gains, limits)
        self.attitude = AttitudeController(gains, limits)
        self.rates = BodyRateController(parameters, gains)
        self.mixer = Mixer(parameters)
        self._limits = limits
        self._max_thrust = parameters.max_thrust
        self._in_position = True
        self._in_velocity = False
        self._target: Quaternion | None = None
        self._target_rates: Vector3 = (0.0, 0.0, 0.0)
        self._thrust = 0.0
        self._motors: Motors | None = None

    def reset(self) -> None:
        """Forget what was learnt in flight (integrals, last measurements)."""
        self.position.reset()
        self.rates.reset()
        self._in_velocity = False

    def follow(self, setpoint: Setpoint, state: State) -> None:
        """Take a set-point; it replaces the last one.

        Args:
            setpoint: The set-point.
            state: The vehicle now: a velocity set-point without yaw rate keeps its heading.

        Raises:
            ValueError: The set-point has a `setpoints.fault`.
        """
        reason = fault(setpoint)
        if reason is not None:
            raise ValueError(reason)
        match setpoint:
            case PositionSetpoint():
                self._take_over()
                self.position.to_position(
                    setpoint.position,
                    setpoint.velocity,
                    setpoint.acceleration,
                    setpoint.yaw,
                    setpoint.yaw_rate,
                )
            case VelocitySetpoint():
                # Renewed set-points turn on from where the last one has turned to.
                yaw = self.position.yaw if self._in_velocity else yaw_of(state.orientation)
                self._take_over()
                self._in_velocity = True
                self.position.to_velocity(
                    setpoint.velocity, yaw, setpoint.yaw_rate, setpoint.frame_id == "heading"
                )
            case AttitudeSetpoint():
                self._target = normalize(setpoint.orientation)
                self._take_thrust(setpoint.thrust)
            case BodyRateSetpoint():
                tilt, yaw = self._limits.tilt_rate, self._limits.yaw_rate
                x, y, z = setpoint.angular_velocity
                self._target = None
                self._target_rates = (_clip(x, tilt), _clip(y, tilt), _clip(z, yaw))
                self._take_thrust(setpoint.thrust)
            case MotorSetpoint():
                a, b, c, d = setpoint.motor1, setpoint.motor2, setpoint.motor3, setpoint.motor4
                self._take_thrust(0.0)
                self._motors = (_share(a), _share(b), _share(c), _share(d))

    def hold(self, position: Vector3, velocity: Vector3, yaw: float) -> None:
        """Fly to a position (m, NED) with a velocity (m/s, NED), for the autopilot's manoeuvres."""
        self._take_over()
        self.position.to_position(position, velocity, yaw=yaw)

    def brake(self, state: State, vertical_velocity: float = 0.0) -> None:
        """Stop and hold the place, or go on only up or down (m/s, NED), looking where it looks."""
        self._take_over()
        self.position.brake(yaw_of(state.orientation), vertical_velocity)

    def update(self, state: State, dt: float) -> Motors:
        """Return the motor commands for now.

        Args:
            state: State of the vehicle.
            dt: Seconds since the last update, > 0.
        """
        if self._motors is not None:
            return self._motors
        if self._in_position:
            target, thrust, yaw_rate = self.position.update(state, dt)
            rates = self.attitude.update(state.orientation, target, yaw_rate)
        else:
            thrust = self._thrust
            rates = (
                self._target_rates
                if self._target is None
                else self.attitude.update(state.orientation, self._target, 0.0)
            )
        roll, pitch, yaw = self.rates.update(state.angular_velocity, rates, dt)
        return self.mixer.mix(thrust, roll, pitch, yaw)

    def _take_over(self) -> None:
        """Go to position or velocity flight; what its loops remember from before is stale."""
        if not self._in_position:
            self.position.reset()
        self._leave_motors()
        self._in_position = True
        self._in_velocity = False

    def _leave_motors(self) -> None:
        """Let the loops turn the motors again; what they remember from before is stale."""
        if self._motors is not None:
            self._motors = None
            self.rates.reset()

    def _take_thrust(self, thrust: float) -> None:
        self._leave_motors()
        self._thrust = _share(thrust) * self._max_thrust
        self._in_position = self._in_velocity = False


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))


def _clip(value: float, limit: float) -> float:
    return min(limit, max(-limit, value))


Setpoint = PositionSetpoint | VelocitySetpoint | AttitudeSetpoint | BodyRateSetpoint | MotorSetpoint
"""What the cascade can follow."""

MOST = 1e6
"""In SI units; squares of much greater numbers would overflow in the control loops."""


def fault(setpoint: Setpoint) -> str | None:
    """Return what is wrong with a set-point, None if nothing is."""
    match setpoint:
        case PositionSetpoint():
            numbers = [*setpoint.position, *setpoint.velocity, *setpoint.acceleration]
            numbers += [setpoint.yaw, setpoint.yaw_rate]
        case VelocitySetpoint():
            if setpoint.frame_id not in ("map", "heading"):
                return (
                    "VelocitySetpoint.frame_id: expected 'map' or 'heading', "
                    f"found {setpoint.frame_id!r}"
                )
            numbers = [*setpoint.velocity, setpoint.yaw_rate]
        case AttitudeSetpoint():
            numbers = [setpoint.thrust]
        case BodyRateSetpoint():
            numbers = [*setpoint.angular_velocity, setpoint.thrust]
        case MotorSetpoint():
            numbers = [setpoint.motor1, setpoint.motor2, setpoint.motor3, setpoint.motor4]
    if not all(-MOST <= number <= MOST for number in numbers):
        return f"{type(setpoint).__name__}: expected numbers up to {MOST:g}, found {setpoint}"
    return None
