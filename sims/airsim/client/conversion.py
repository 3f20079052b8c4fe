"""From AirSim's structures to events: out of a vehicle's local NED, into ``map``.

All raise `ValueError` if a number is not finite, or a rotation is none.
"""

from __future__ import annotations

from events import Collision, Imu, Odometry, PoseStamped, Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD, multiply, normalize, rotate, rotate_inverse
from sims.airsim.structures import CollisionInfo, ImuData, MultirotorState, Pose, Vector3r


def vector(found: Vector3r) -> Vector3:
    """Return a vector as events have it."""
    return found.x_val, found.y_val, found.z_val


def pose_of(found: Pose, origin: Vector3 = (0.0, 0.0, 0.0)) -> tuple[Vector3, Quaternion]:
    """Return a pose as events have it, in the frame in which its own frame's origin is given."""
    place, turn = found.position, found.orientation
    position = place.x_val + origin[0], place.y_val + origin[1], place.z_val + origin[2]
    return position, normalize((turn.w_val, turn.x_val, turn.y_val, turn.z_val))


def odometry(stamp: int, source: str, found: MultirotorState, origin: Vector3) -> Odometry:
    """Return the true state of a vehicle."""
    state = found.kinematics_estimated
    position, orientation = pose_of(Pose(state.position, state.orientation), origin)
    return Odometry(
        stamp=stamp,
        source=source,
        position=position,
        orientation=orientation,
        linear_velocity=rotate_inverse(orientation, vector(state.linear_velocity)),
        angular_velocity=vector(state.angular_velocity),
    )


def imu(stamp: int, source: str, found: ImuData) -> Imu:
    """Return a sample of the IMU."""
    turn, force = vector(found.angular_velocity), vector(found.linear_acceleration)
    return Imu(stamp=stamp, source=source, angular_velocity=turn, linear_acceleration=force)


def camera_pose(stamp: int, source: str, found: Pose, origin: Vector3) -> PoseStamped:
    """Return the pose of a camera's optical frame."""
    position, turn = pose_of(found, origin)
    orientation = normalize(multiply(turn, OPTICAL_TO_FRD))
    return PoseStamped(stamp=stamp, source=source, position=position, orientation=orientation)


def collision(
    stamp: int, source: str, found: CollisionInfo, origin: Vector3, vehicle: Odometry
) -> Collision:
    """Return a contact; its speed is that of the vehicle against the normal."""
    normal, place = vector(found.normal), Pose(found.impact_point)
    velocity = rotate(vehicle.orientation, vehicle.linear_velocity)
    return Collision(
        stamp=stamp,
        source=source,
        other=found.object_name,
        position=pose_of(place, origin)[0],
        normal=normal,
        speed=max(-sum(a * b for a, b in zip(normal, velocity, strict=True)), 0.0),
    )
