"""AirSim's structures, as maps by these names on the wire.

Source: AirLib's ``api/RpcLibAdaptorsBase.hpp`` and ``vehicles/multirotor/api`` in AirSim 1.8.1.
Unknown keys of incoming maps are ignored, missing ones keep these defaults. Units are SI; frames
are NED and FRD. Numbers may be NaN, which often means "keep".
"""

from __future__ import annotations

from typing import Any

import msgspec

NAN = float("nan")


class Vector3r(msgspec.Struct, frozen=True):
    """Three numbers."""

    x_val: float = 0.0
    y_val: float = 0.0
    z_val: float = 0.0


class Quaternionr(msgspec.Struct, frozen=True):
    """A rotation, Hamilton's, from the body to the parent frame."""

    w_val: float = 1.0
    x_val: float = 0.0
    y_val: float = 0.0
    z_val: float = 0.0


class Pose(msgspec.Struct, frozen=True):
    """A position, metres, and an orientation; of one that is not known all is NaN."""

    position: Vector3r = Vector3r()
    orientation: Quaternionr = Quaternionr()


class GeoPoint(msgspec.Struct, frozen=True):
    """Degrees north and east, and metres above the sea."""

    latitude: float = 0.0
    longitude: float = 0.0
    altitude: float = 0.0


class YawMode(msgspec.Struct, frozen=True):
    """A heading in degrees, or degrees per second; clockwise from north seen from above."""

    is_rate: bool = True
    yaw_or_rate: float = 0.0


class KinematicsState(msgspec.Struct, frozen=True):
    """How something moves: angular velocity and acceleration in its own frame, all else in NED."""

    position: Vector3r = Vector3r()
    orientation: Quaternionr = Quaternionr()
    linear_velocity: Vector3r = Vector3r()
    angular_velocity: Vector3r = Vector3r()
    linear_acceleration: Vector3r = Vector3r()
    angular_acceleration: Vector3r = Vector3r()


class CollisionInfo(msgspec.Struct, frozen=True):
    """The last contact; `time_stamp` in ns, positions metres in the vehicle's local NED."""

    has_collided: bool = False
    penetration_depth: float = 0.0
    time_stamp: int = 0
    normal: Vector3r = Vector3r()
    impact_point: Vector3r = Vector3r()
    position: Vector3r = Vector3r()
    object_name: str = ""
    object_id: int = -1


class RCData(msgspec.Struct, frozen=True):
    """A remote control, which is never there."""

    timestamp: int = 0
    pitch: float = 0.0
    roll: float = 0.0
    throttle: float = 0.0
    yaw: float = 0.0
    left_z: float = 0.0
    right_z: float = 0.0
    switches: int = 0
    vendor_id: str = ""
    is_initialized: bool = False
    is_valid: bool = False


class MultirotorState(msgspec.Struct, frozen=True):
    """State of a multirotor; `landed_state` is 0 on the ground and 1 in the air."""

    collision: CollisionInfo = CollisionInfo()
    kinematics_estimated: KinematicsState = KinematicsState()
    gps_location: GeoPoint = GeoPoint()
    timestamp: int = 0
    landed_state: int = 0
    rc_data: RCData = RCData()


class ComputerVisionState(msgspec.Struct, frozen=True):
    """State of a free camera, as Cosys-AirSim has it."""

    kinematics_estimated: KinematicsState = KinematicsState()
    timestamp: int = 0


class ImageRequest(msgspec.Struct, frozen=True):
    """An image to take; `image_type` is one of `sims.airsim.server.images`."""

    camera_name: str = ""
    image_type: int = 0
    pixels_as_float: bool = False
    compress: bool = True
    annotation_name: str = ""


class ImageResponse(msgspec.Struct, frozen=True):
    """An image; either `image_data_uint8` or `image_data_float` is empty.

    On our side, `image_data_float` is what `sims.airsim.wire.float_array` returns.
    """

    image_data_uint8: bytes = b""
    image_data_float: Any = ()
    camera_position: Vector3r = Vector3r()
    camera_name: str = ""
    camera_orientation: Quaternionr = Quaternionr()
    time_stamp: int = 0
    message: str = ""
    pixels_as_float: bool = False
    compress: bool = True
    width: int = 0
    height: int = 0
    image_type: int = 0


class CosysImageResponse(ImageResponse, frozen=True):
    """An image as Cosys-AirSim sends it."""

    annotation_name: str = ""


class ProjectionMatrix(msgspec.Struct, frozen=True):
    """Rows of a 4×4 matrix."""

    matrix: tuple[tuple[float, float, float, float], ...] = ()


class CameraInfo(msgspec.Struct, frozen=True):
    """Pose in the vehicle's local NED, horizontal field of view in degrees, projection."""

    pose: Pose = Pose()
    fov: float = 90.0
    proj_mat: ProjectionMatrix = ProjectionMatrix()


class ImuData(msgspec.Struct, frozen=True):
    """An IMU's sample: rad/s and m/s² in the body's frame; the true orientation."""

    time_stamp: int = 0
    orientation: Quaternionr = Quaternionr()
    angular_velocity: Vector3r = Vector3r()
    linear_acceleration: Vector3r = Vector3r()


class BarometerData(msgspec.Struct, frozen=True):
    """A barometer's sample: metres, Pa, and hPa of the air at sea level."""

    time_stamp: int = 0
    altitude: float = 0.0
    pressure: float = 0.0
    qnh: float = 1013.25


class MagnetometerData(msgspec.Struct, frozen=True):
    """A magnetometer's sample, Gauss in the body's frame."""

    time_stamp: int = 0
    magnetic_field_body: Vector3r = Vector3r()
    magnetic_field_covariance: tuple[float, ...] = ()


class GnssReport(msgspec.Struct, frozen=True):
    """What a receiver says; `time_utc` in µs."""

    geo_point: GeoPoint = GeoPoint()
    eph: float = 0.0
    epv: float = 0.0
    velocity: Vector3r = Vector3r()
    fix_type: int = 0
    time_utc: int = 0


class GpsData(msgspec.Struct, frozen=True):
    """A receiver's sample."""

    time_stamp: int = 0
    gnss: GnssReport = GnssReport()
    is_valid: bool = False


class DistanceSensorData(msgspec.Struct, frozen=True):
    """A range finder's sample, metres; the sensor's pose in the body's frame."""

    time_stamp: int = 0
    distance: float = 0.0
    min_distance: float = 0.0
    max_distance: float = 0.0
    relative_pose: Pose = Pose()


class LidarData(msgspec.Struct, frozen=True):
    """A lidar's scan: x, y, z of all points in one list; the sensor's pose in local NED."""

    time_stamp: int = 0
    point_cloud: Any = ()
    pose: Pose = Pose()
    segmentation: Any = ()


class CosysLidarData(msgspec.Struct, frozen=True):
    """A lidar's scan as Cosys-AirSim sends it: the name of what each point lies on."""

    time_stamp: int = 0
    point_cloud: Any = ()
    pose: Pose = Pose()
    groundtruth: tuple[str, ...] = ()


class EnvironmentState(msgspec.Struct, frozen=True):
    """The air and the earth round a vehicle: Pa, K, kg/m³, m/s²."""

    position: Vector3r = Vector3r()
    geo_point: GeoPoint = GeoPoint()
    gravity: Vector3r = Vector3r()
    air_pressure: float = 0.0
    temperature: float = 0.0
    air_density: float = 0.0


class RotorParameters(msgspec.Struct, frozen=True):
    """One rotor: rad/s, N, N m."""

    speed: float = 0.0
    thrust: float = 0.0
    torque_scaler: float = 0.0


class RotorStates(msgspec.Struct, frozen=True):
    """All rotors of a vehicle."""

    timestamp: int = 0
    rotors: tuple[RotorParameters, ...] = ()
