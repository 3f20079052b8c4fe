"""AirSim's msgpack-rpc and structures: bytes to messages and back. No sockets.

A connection carries msgpack objects one after another, without frames: a request is ``[0, id,
"method", [arguments]]``, its reply ``[1, id, error, result]``. Source: the specification of
msgpack-rpc (https://github.com/msgpack-rpc/msgpack-rpc) and rpclib, which AirSim uses. Structures
are maps by these names. Source: AirLib's ``api/RpcLibAdaptorsBase.hpp`` and
``vehicles/multirotor/api`` in AirSim 1.8.1. Unknown keys of incoming maps are ignored, missing ones
keep these defaults. Units are SI; frames are NED and FRD. Numbers may be NaN, which often means
"keep".
"""

from __future__ import annotations

import reprlib
import struct
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import msgpack
import msgspec
import numpy as np
import numpy.typing as npt

NAN = float("nan")
REQUEST, REPLY = 0, 1
LONGEST = 4 << 20  # bytes of a message that a server takes
MOST_LISTS = 50_000  # lists and maps in one: 4 MB of empty ones would take seconds
LONGEST_REPLY = 1 << 30  # bytes of a message that a client takes: float images are long

Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""In SI units or degrees; no vehicle goes farther or faster."""


class WireFormatError(Exception):
    """Bytes without a valid message; later bytes cannot be understood either."""


class Request(NamedTuple):
    """A call of a method; of a notification, whose answer nobody wants, `id` is `None`."""

    id: int | None
    method: str
    arguments: list[Any]


class Reply(NamedTuple):
    """Outcome of a call: an error's text, or else a result."""

    id: int
    error: Any
    result: Any


class Decoder:
    """Decoder of a connection's bytes into messages of up to `longest` bytes, however split.

    A message is decoded once complete: until then it takes no more memory than its bytes.
    """

    def __init__(self, longest: int = LONGEST) -> None:
        self._longest = longest
        self._splitter = msgpack.Unpacker(max_buffer_size=2**31 - 1)
        self._bytes = bytearray()
        self._begin = 0  # where in the stream `_bytes` begins

    def feed(self, data: bytes) -> Iterator[Request | Reply]:
        """Yield the messages completed by these bytes; `WireFormatError` if invalid or too long."""
        self._bytes += data
        try:
            self._splitter.feed(data)
            while self._next_is_complete():
                end: int = self._splitter.tell()
                length, self._begin = end - self._begin, end
                message = bytes(self._bytes[:length])
                del self._bytes[:length]
                yield decode(message)
        except msgpack.UnpackException as error:
            raise WireFormatError(f"expected msgpack, found {type(error).__name__}") from None

    def _next_is_complete(self) -> bool:
        try:
            self._splitter.skip()
        except msgpack.OutOfData:
            if len(self._bytes) > self._longest:
                raise WireFormatError(
                    f"expected messages of at most {self._longest} bytes, found a longer one"
                ) from None
            return False
        return True


def decode(message: bytes) -> Request | Reply:
    """Return the message in these bytes, invalid UTF-8 replaced, or raise a `WireFormatError`."""
    left = MOST_LISTS

    def count(container: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise WireFormatError(f"expected at most {MOST_LISTS} lists and maps, found more")
        return container

    try:
        decoded = msgpack.unpackb(
            message,
            raw=False,
            unicode_errors="replace",
            strict_map_key=False,
            timestamp=0,
            list_hook=count,
            object_hook=count,
        )
    except WireFormatError:
        raise
    except Exception as error:  # of many kinds, by the bytes
        raise WireFormatError(f"expected msgpack, found {type(error).__name__}: {error}") from None
    match decoded:
        case [0, int(id_), str(method), list(arguments)]:
            return Request(id_, method, arguments)
        case [1, int(id_), error, result]:
            return Reply(id_, error, result)
        case [2, str(method), list(arguments)]:
            return Request(None, method, arguments)
    raise WireFormatError(f"expected a request or a reply, found {reprlib.repr(decoded)}")


_encode = msgspec.msgpack.Encoder().encode


def request(id_: int, method: str, arguments: tuple[Any, ...] | list[Any]) -> bytes:
    """Return the bytes of a call."""
    return _encode((REQUEST, id_, method, arguments))


def reply(id_: int, error: str | None, result: Any) -> bytes:
    """Return an answer's bytes: structs as maps, bytes as ``bin``; `TypeError` for others."""
    return _encode((REPLY, id_, error, result))


def float_array(numbers: npt.NDArray[Any]) -> msgspec.Raw:
    """Return any array as rpclib packs a ``std::vector<float>``, in C order, for `reply`."""
    flat = np.ascontiguousarray(numbers, np.float32).ravel()
    packed = np.empty(len(flat), [("kind", "u1"), ("value", ">f4")])
    packed["kind"], packed["value"] = 0xCA, flat
    return msgspec.Raw(struct.pack(">BI", 0xDD, len(flat)) + packed.tobytes())


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
    """Position, metres, and orientation; all NaN if unknown."""

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
    yaw_or_rate: Number = 0.0


class KinematicsState(msgspec.Struct, frozen=True):
    """Motion of a body: angular velocity and acceleration in its own frame, all else in NED."""

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
    """State of a remote control, always absent."""

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
    """State of a free camera, in Cosys-AirSim's format."""

    kinematics_estimated: KinematicsState = KinematicsState()
    timestamp: int = 0


class ImageRequest(msgspec.Struct, frozen=True):
    """Request for an image; for `image_type` see `visnav_airsim.server.rendering`."""

    camera_name: str = ""
    image_type: int = 0
    pixels_as_float: bool = False
    compress: bool = True
    annotation_name: str = ""


class ImageResponse(msgspec.Struct, frozen=True):
    """An image as bytes, or as floats (`visnav_airsim.wire.float_array`); the other is empty."""

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
    """Image in Cosys-AirSim's format."""

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
    """Report of a GNSS receiver; `time_utc` in µs."""

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
    """Lidar scan: x, y, z of all points in a single list; sensor pose in local NED."""

    time_stamp: int = 0
    point_cloud: Any = ()
    pose: Pose = Pose()
    segmentation: Any = ()


class CosysLidarData(msgspec.Struct, frozen=True):
    """Lidar scan in Cosys-AirSim's format: with the name of the object at each point."""

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
    """State of a rotor: rad/s, N, N m."""

    speed: float = 0.0
    thrust: float = 0.0
    torque_scaler: float = 0.0


class RotorStates(msgspec.Struct, frozen=True):
    """All rotors of a vehicle."""

    timestamp: int = 0
    rotors: tuple[RotorParameters, ...] = ()
