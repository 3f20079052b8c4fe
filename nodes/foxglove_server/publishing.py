"""Topics by source, and which message an event becomes.

Images and point clouds are put from threads beside the loop, one of each kind at a time; the
rest takes some microseconds and is put at once. A frame ``world``, z up, is above ``map``, for
viewers that have no other up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    LidarScan,
    NavSatFix,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    PositionSetpoint,
    Quaternion,
    Score,
    SensorAnnouncement,
    TrackedFeatures,
    TrackingEvent,
    Vector3,
    VehicleAnnouncement,
    VehicleEvent,
    Wind,
)
from nodes.foxglove_server.messages import SCORE_SCHEMA, Messages, measurement_schema
from nodes.foxglove_server.server import Server
from nodes.foxglove_server.settings import FoxgloveConfig
from nodes.trajectory import RecentPoses
from nodes.vehicles import Vehicles
from nodes.viewing.appearance import PLAN, Colour, estimate_colour, moving_body, truth_colour
from nodes.viewing.measurements import MEASURED
from nodes.viewing.paths import Trail, estimate_frame
from nodes.viewing.selection import PlanSelection

_MAP_IN_WORLD: Quaternion = (0.0, 0.5**0.5, 0.5**0.5, 0.0)
"""North, east, down in east, north, up."""


E = TypeVar("E", bound=Event)

LARGE: tuple[type[Event], ...] = (Image, DepthImage, TrackedFeatures, PointCloud, LidarScan)
"""Events whose messages take long to make: `Publishing.large` has a function for each."""

SMALL: tuple[type[Event], ...] = (
    *MEASURED,
    *(Odometry, PoseEstimate, PoseStamped, Score),
    *(PlannedPose, PositionSetpoint, TrackingEvent, VehicleEvent),
)
"""Events that `Publishing.small` takes."""


class Publishing:
    """Turns events into messages."""

    def __init__(self, server: Server, config: FoxgloveConfig) -> None:
        self._server = server
        self._config = config
        self._make = Messages(server.types)
        self._cameras: dict[str, CameraAnnouncement] = {}  # by source
        self._frames: dict[str, str] = {}  # sources of images, by optical frame
        self._bodies: dict[str, str] = {}  # frames, by vehicle
        self._estimators: dict[str, str] = {}  # parent frames, by source
        self._renamed: dict[str, str] = {}  # the same by what the estimators call them
        self._vehicles = Vehicles()
        self._truths: dict[str, RecentPoses] = {}  # by vehicle
        self._trails: dict[str, Trail] = {}
        self._drawn: list[Any] = []
        self._moving: set[str] = set()  # bodies that move by themselves
        self._static: list[Any] = []
        self._plan = PlanSelection()
        self.large: dict[type[Event], Callable[[Any], None]] = dict(
            zip(LARGE, (self.image, self.depth, self.features, self.cloud, self.scan), strict=True)
        )
        for topic, kind in (
            ("/tf", "FrameTransforms"),
            ("/tf_static", "FrameTransforms"),
            ("/scene", "SceneUpdate"),
            ("/log", "Log"),
        ):
            server.declare(topic, kind)
        self._fix(0, "world", "map", (0.0, 0.0, 0.0), _MAP_IN_WORLD)
        server.latch("/scene", self._whole_scene, 0)

    # Before the first event.

    def announced(self, announcement: Announcement) -> None:
        """Declare the topics of what is announced."""
        topic = _topic(announcement.source)
        self._vehicles.announced(announcement)
        match announcement:
            case VehicleAnnouncement():
                self._vehicle(announcement.source, "base_link")
            case EstimatorAnnouncement():
                self._server.declare(f"{topic}/pose", "PoseInFrame")
            case CameraAnnouncement():
                self._camera(announcement)
            case BodyAnnouncement():
                box = moving_body(announcement.kind)
                self._moving.add(announcement.source)
                self._draw(self._make.body(announcement.source, announcement.source, [box]))
            case ImuAnnouncement() | SensorAnnouncement():
                self._sensor(announcement)

    def _sensor(self, sensor: ImuAnnouncement | SensorAnnouncement) -> None:
        if isinstance(sensor, ImuAnnouncement):
            self._server.declare_json(_topic(sensor.source), measurement_schema(Imu))
        if sensor.frame_id != sensor.parent_frame_id:
            parent = self._frame(sensor.parent_frame_id, sensor.source)
            place = sensor.position, sensor.orientation
            self._fix(sensor.stamp, parent, self._frame(sensor.frame_id, sensor.source), *place)

    def _camera(self, camera: CameraAnnouncement) -> None:
        server, topic = self._server, _topic(camera.source)
        self._cameras[camera.source] = camera
        self._frames.setdefault(camera.frame_id, camera.source)
        calibration = self._make.calibration(camera)
        server.declare(f"{topic}/camera_info", "CameraCalibration")
        server.latch(f"{topic}/camera_info", lambda: calibration, camera.stamp)
        for kind in camera.images if self._config.image_rate else ():
            if kind == "grey" and "rgb" in camera.images:
                server.declare(*self._image_topic(f"{camera.source}/grey"))
            elif kind in ("rgb", "grey"):
                server.declare(*self._image_topic(camera.source))
            elif kind == "depth" and self._config.depth:
                server.declare(f"{topic}/depth", "RawImage")
        if camera.parent_frame_id != "map" and not camera.undistorted:
            parent = self._frame(camera.parent_frame_id, camera.source)
            self._fix(camera.stamp, parent, camera.frame_id, camera.position, camera.orientation)

    # Beside the loop.

    def image(self, event: Image) -> None:
        """Put an image."""
        self._frames.setdefault(event.frame_id, event.source)
        topic, type_ = self._image_topic(event.source)
        if quality := self._config.jpeg_quality:
            self._put(topic, type_, event, lambda each: self._make.compressed(each, quality))
        else:
            self._put(topic, type_, event, self._make.image)

    def depth(self, event: DepthImage) -> None:
        """Put a depth image."""
        self._put(f"{_topic(event.source)}/depth", "RawImage", event, self._make.depth)

    def features(self, event: TrackedFeatures) -> None:
        """Put the features that an estimator tracks in an image."""
        if (camera := self._frames.get(event.frame_id)) is not None:
            topic = f"{_topic(camera)}/features{_topic(event.source)}"
            self._put(topic, "ImageAnnotations", event, self._make.features)

    def cloud(self, event: PointCloud) -> None:
        """Put a point cloud; viewers that connect later get the newest."""
        topic = f"{_topic(event.source)}/cloud"
        self._server.declare(topic, "PointCloud")
        message = self._make.cloud(event, self._renamed.get(event.frame_id, event.frame_id))
        self._server.latch(topic, lambda: message, event.stamp)

    def scan(self, event: LidarScan) -> None:
        """Put a turn of a lidar."""
        frame = self._frame(event.frame_id, event.source)
        topic = f"{_topic(event.source)}/points"
        self._put(topic, "PointCloud", event, lambda each: self._make.scan(each, frame))

    def _put(self, topic: str, type_: str, event: E, make: Callable[[E], Any]) -> None:
        """Declare a topic, and put the message of an event if anybody looks."""
        self._server.declare(topic, type_)
        if self._server.wanted(topic):
            self._server.log(topic, make(event), event.stamp)

    # At once.

    def tracked(self, event: TrackedFeatures) -> None:
        """Note whose images an estimator looks at."""
        self._vehicles.tracked(event)

    def small(self, event: Event) -> None:
        """Put the messages of an event that is no image and no point cloud."""
        match event:
            case Odometry():
                self.odometry(event)
            case PoseEstimate():
                self.estimate(event)
            case PoseStamped():
                self.camera_pose(event)
            case Score():
                self.score(event)
            case PlannedPose() | PositionSetpoint():
                self.plan(event)
            case TrackingEvent() | VehicleEvent():
                self.logged(event)
            case _:
                self.measurement(event)

    def odometry(self, event: Odometry) -> None:
        """Put where a vehicle truly is, as a message and as a transform."""
        stamp, source = event.stamp, event.source
        body = self._vehicle(source, event.child_frame_id)
        self._server.log(f"{_topic(source)}/odometry", self._make.odometry(event, body), stamp)
        self._move(stamp, event.frame_id, body, event.position, event.orientation)
        self._truths[source].add(stamp, event.position, event.orientation)
        colour = truth_colour(list(self._bodies).index(source))
        self._extend(f"truth/{source}", event.frame_id, colour, stamp, event.position)

    def estimate(self, event: PoseEstimate) -> None:
        """Put an estimate, and the frame it places: ``<estimator>/<body>``.

        Estimates that are not in ``map`` begin at the true pose of their time.
        """
        stamp, source = event.stamp, event.source
        topic = f"{_topic(source)}/pose"
        self._server.declare(topic, "PoseInFrame")
        parent = self._estimators.get(source)
        if parent is None:
            parent = self._estimators[source] = self._parent_of(event)
        self._server.log(topic, self._make.pose(event, parent), stamp)
        body = f"{source}/{event.child_frame_id}"
        self._move(stamp, parent, body, event.position, event.orientation)
        colour = estimate_colour(list(self._estimators).index(source))
        self._extend(f"estimate/{source}", parent, colour, stamp, event.position)

    def plan(self, event: PlannedPose | PositionSetpoint) -> None:
        """Draw where a vehicle is meant to be."""
        if self._plan.select(event):
            name = f"plan/{event.vehicle}" if event.vehicle else "plan"
            self._extend(name, "map", PLAN, event.stamp, event.position)

    def camera_pose(self, event: PoseStamped) -> None:
        """Put where a free camera is, or a body that moves by itself."""
        if event.source in self._moving:
            pose = event.position, event.orientation
            self._move(event.stamp, event.frame_id, event.source, *pose)
        camera = self._cameras.get(event.source)
        if camera is not None and camera.parent_frame_id == "map":
            pose = event.position, event.orientation
            self._move(event.stamp, event.frame_id, camera.frame_id, *pose)

    def measurement(self, event: Event) -> None:
        """Put a measurement; a satellite receiver's also onto the map."""
        topic, stamp = _topic(event.source), event.stamp
        if isinstance(event, NavSatFix):
            self._server.declare(f"{topic}/fix", "LocationFix")
            frame = self._frame("base_link", event.source)
            self._server.log(f"{topic}/fix", self._make.fix(event, frame), stamp)
        if isinstance(event, Wind):
            topic += "/wind"
        self._server.declare_json(topic, measurement_schema(type(event)))
        self._server.log(topic, self._make.measurement(event), stamp)

    def score(self, event: Score) -> None:
        """Put a score."""
        topic = f"/scores{_topic(event.subject)}/{event.metric}"
        self._server.declare_json(topic, SCORE_SCHEMA)
        self._server.log(topic, self._make.score(event), event.stamp)

    def logged(self, event: Event) -> None:
        """Put an event into the log, in words."""
        self._server.log("/log", self._make.log(event), event.stamp)

    # What these share.

    def _vehicle(self, source: str, frame_id: str) -> str:
        """Return a vehicle's frame: the first has its own, others have their name before it."""
        if (known := self._bodies.get(source)) is not None:
            return known
        body = self._bodies[source] = f"{source}/{frame_id}" if self._bodies else frame_id
        self._server.declare(f"{_topic(source)}/odometry", "Odometry")
        self._truths[source] = RecentPoses()
        self._draw(self._make.body(source, body))
        return body

    def _draw(self, body: Any) -> None:
        self._drawn.append(body)
        self._server.latch("/scene", self._whole_scene, 0)

    def _frame(self, frame_id: str, source: str) -> str:
        """Return what a frame is called of which each vehicle has one: the body's."""
        vehicle = self._vehicles.of(source)
        return self._bodies.get(vehicle, frame_id) if frame_id == "base_link" else frame_id

    def _parent_of(self, event: PoseEstimate) -> str:
        """Return the frame that an estimator works in, aligned with the truth if it is its own."""
        if event.frame_id == "map":
            return "map"
        frame_id = f"{event.source}/{event.frame_id}"
        self._renamed.setdefault(event.frame_id, frame_id)
        truth = self._truths.get(self._vehicles.of(event.source))
        if (frame := estimate_frame(event, truth)) is not None:
            self._fix(event.stamp, "map", frame_id, *frame)
        return frame_id

    def _fix(self, stamp: int, parent: str, child: str, at: Vector3, turned: Quaternion) -> None:
        """Put a transform that holds from now on."""
        self._static.append(self._make.transform(stamp, parent, child, at, turned))
        message = self._make.transforms(*self._static)
        self._server.latch("/tf_static", lambda: message, stamp)

    def _move(self, stamp: int, parent: str, child: str, at: Vector3, turned: Quaternion) -> None:
        """Put a transform that holds for now."""
        if self._server.wanted("/tf"):
            placed = self._make.transform(stamp, parent, child, at, turned)
            self._server.log("/tf", self._make.transforms(placed), stamp)

    def _extend(self, name: str, frame_id: str, colour: Colour, stamp: int, at: Vector3) -> None:
        """Draw on at a path."""
        trail = self._trails.get(name)
        if trail is None:
            thickness = 0.04 if name.startswith("truth") else 0.02
            trail = self._trails[name] = Trail(name, frame_id, colour, thickness)
        if (piece := trail.add(stamp, at)) is not None and self._server.wanted("/scene"):
            self._server.log("/scene", self._make.scene(self._make.line(trail, *piece)), stamp)

    def _whole_scene(self) -> Any:
        """Return all that is drawn, for a viewer that connects; in any thread."""
        lines = [
            self._make.line(trail, name, piece)
            for trail in list(self._trails.values())
            for name, piece in trail.pieces()
        ]
        return self._make.scene(*list(self._drawn), *lines)

    def _image_topic(self, source: str) -> tuple[str, str]:
        """Return the topic of images, and its type.

        A camera with both ``rgb`` and ``grey`` sends the grey ones as ``<source>/grey``.
        """
        type_ = "CompressedImage" if self._config.jpeg_quality else "RawImage"
        extra = source.endswith("/grey") and source.removesuffix("/grey") in self._cameras
        return _topic(source) if extra else f"{_topic(source)}/image", type_


def _topic(source: str) -> str:
    return f"/{source.strip('/')}"
