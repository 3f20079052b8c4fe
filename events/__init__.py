"""Events exchanged by nodes: frozen, typed data, and nothing else.

No asyncio, no input or output, no imports from the other rooms. A node's own events subclass
`Event`; those here are shared, so that two people's nodes fit together. They are checked when they
are made (`events.base`): integer stamps, finite numbers, unit quaternions.
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
from events.base import (
    Category,
    Event,
    KeyPressed,
    KeyReleased,
    ParameterChanged,
    Quaternion,
    Shutdown,
    Vector3,
    WindowClosed,
    WindowResized,
)
from events.camera_info import CameraInfo
from events.control import (
    Arm,
    Armed,
    AttitudeSetpoint,
    BodyRateSetpoint,
    Collision,
    Command,
    Disarm,
    Disarmed,
    Hover,
    Land,
    Landed,
    MotorSetpoint,
    PlannedPose,
    PoseSetpoint,
    PositionSetpoint,
    Reset,
    Setpoint,
    TakenOff,
    Takeoff,
    Teleport,
    VehicleEvent,
    VelocitySetpoint,
)
from events.estimates import (
    PointCloud,
    PoseEstimate,
    Score,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
    TrajectoryEstimate,
)
from events.geometry import Odometry, PoseStamped, TransformStamped, Wind
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

__all__ = [
    "Announcement", "Arm", "Armed", "AttitudeSetpoint", "BarometerAnnouncement", "BodyAnnouncement",
    "BodyRateSetpoint", "CameraAnnouncement", "CameraInfo", "Category", "Collision", "Command",
    "DepthImage", "Disarm", "Disarmed", "EstimatorAnnouncement", "Event", "FluidPressure", "Hover",
    "Image", "Imu", "ImuAnnouncement", "KeyPressed", "KeyReleased", "Land", "Landed",
    "LidarAnnouncement", "LidarScan", "MagneticField", "MagnetometerAnnouncement", "MotorSetpoint",
    "NavSatAnnouncement", "NavSatFix", "Odometry", "ParameterChanged", "PathAnnouncement",
    "PilotAnnouncement", "PlannedPose", "PointCloud", "PoseEstimate", "PoseSetpoint", "PoseStamped",
    "PositionSetpoint", "Quaternion", "Range", "RangeAnnouncement", "Reset", "Score",
    "SegmentationImage", "SensorAnnouncement", "Setpoint", "Shutdown", "TakenOff", "Takeoff",
    "Teleport", "TrackedFeatures", "TrackingEvent", "TrackingLost", "TrackingRegained",
    "TrajectoryEstimate", "TransformStamped", "Vector3", "VehicleAnnouncement", "VehicleEvent",
    "VelocitySetpoint", "Wind", "WindAnnouncement", "WindowClosed", "WindowResized",
]  # fmt: skip
