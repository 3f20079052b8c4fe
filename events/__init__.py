"""The events that nodes send each other: frozen, typed data, and nothing else.

No asyncio, no input or output, no imports from the other rooms. A node's own events subclass
`Event`; those here are shared, so that two people's nodes fit together. They are checked when they
are made (`events.checks`): integer stamps, finite numbers, unit quaternions.
"""

from events.announcements import (
    Announcement,
    BarometerAnnouncement,
    BodyAnnouncement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    ImuAnnouncement,
    LidarAnnouncement,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    PathAnnouncement,
    PilotAnnouncement,
    RangeAnnouncement,
    SensorAnnouncement,
    VehicleAnnouncement,
    WindAnnouncement,
)
from events.base import Category, Event, Quaternion, Vector3
from events.camera_info import CameraInfo
from events.control import (
    Arm,
    AttitudeSetpoint,
    BodyRateSetpoint,
    Command,
    Disarm,
    Hover,
    Land,
    PlannedPose,
    PoseSetpoint,
    PositionSetpoint,
    Setpoint,
    Takeoff,
    VelocitySetpoint,
)
from events.estimates import (
    PoseEstimate,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
)
from events.geometry import Odometry, PoseStamped, TransformStamped, Wind
from events.lifecycle import ParameterChanged, Shutdown
from events.maps import PointCloud
from events.scores import Score
from events.sensors import (
    DepthImage,
    FluidPressure,
    Image,
    Imu,
    LidarScan,
    MagneticField,
    NavSatFix,
    Range,
    SegmentationImage,
)
from events.vehicle import Armed, Collision, Disarmed, Landed, TakenOff, VehicleEvent
from events.window import KeyPressed, KeyReleased, WindowClosed, WindowResized

__all__ = [
    "Announcement",
    "Arm",
    "Armed",
    "AttitudeSetpoint",
    "BarometerAnnouncement",
    "BodyAnnouncement",
    "BodyRateSetpoint",
    "CameraAnnouncement",
    "CameraInfo",
    "Category",
    "Collision",
    "Command",
    "DepthImage",
    "Disarm",
    "Disarmed",
    "EstimatorAnnouncement",
    "Event",
    "FluidPressure",
    "Hover",
    "Image",
    "Imu",
    "ImuAnnouncement",
    "KeyPressed",
    "KeyReleased",
    "Land",
    "Landed",
    "LidarAnnouncement",
    "LidarScan",
    "MagneticField",
    "MagnetometerAnnouncement",
    "NavSatAnnouncement",
    "NavSatFix",
    "Odometry",
    "ParameterChanged",
    "PathAnnouncement",
    "PilotAnnouncement",
    "PlannedPose",
    "PointCloud",
    "PoseEstimate",
    "PoseSetpoint",
    "PoseStamped",
    "PositionSetpoint",
    "Quaternion",
    "Range",
    "RangeAnnouncement",
    "Score",
    "SegmentationImage",
    "SensorAnnouncement",
    "Setpoint",
    "Shutdown",
    "TakenOff",
    "Takeoff",
    "TrackedFeatures",
    "TrackingEvent",
    "TrackingLost",
    "TrackingRegained",
    "TransformStamped",
    "Vector3",
    "VehicleAnnouncement",
    "VehicleEvent",
    "VelocitySetpoint",
    "Wind",
    "WindAnnouncement",
    "WindowClosed",
    "WindowResized",
]
