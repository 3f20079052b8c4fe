"""Entities in the world: vehicles, paths, estimates, cameras with their images, clouds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from events import (
    BodyAnnouncement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Image,
    ImuAnnouncement,
    LidarScan,
    Odometry,
    PlannedPose,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    PositionSetpoint,
    SegmentationImage,
    SensorAnnouncement,
    TrackedFeatures,
    Vector3,
    Wind,
)
from events.announcements import Vehicles
from nodes.ros2.messages.images import depth_in_steps, encode_depth, encode_image
from nodes.trajectory import RecentPoses
from nodes.viewers.common import (
    INLIER,
    OUTLIER,
    PLAN,
    VEHICLE,
    WIND,
    Colour,
    PathPieces,
    PlanSelection,
    estimate_colour,
    estimate_frame,
    moving_body,
    truth_colour,
)
from visnav_rerun import entities
from visnav_rerun.entities import EntityLog, Numbered, ScenePoints
from visnav_rerun.sdk import RerunConfig

CENTIMETRES = 100.0  # steps of a depth image per metre; finer ones would be noise
_WIND_PERIOD = 100_000_000  # nanoseconds between two arrows of a vehicle's wind
_THICK, _THIN = 0.02, 0.01  # metres: radii of paths

Planned = PlannedPose | PositionSetpoint


class World:
    """Writer of the entities with a place in the world."""

    def __init__(self, log: EntityLog, config: RerunConfig) -> None:
        self._entity_log = log
        self._rr = log.rr
        self._config = config
        self._truth: dict[str, RecentPoses] = {}
        self._cameras: dict[str, CameraAnnouncement] = {}  # by source
        self._entities: dict[str, str] = {}  # of cameras, by source
        self._frames: dict[str, str] = {}  # the same by optical frame; the first camera's
        self._moving: set[str] = set()  # bodies that move by themselves
        self._wind_due: dict[str, int] = {}  # by vehicle
        self.vehicles = Vehicles()
        # Entities of bodies' and of estimators' own frames, by frame.
        self._other_frames: dict[str, str] = {}
        self._scene_points: dict[str, ScenePoints] = {}  # by source
        self._anchored: set[str] = set()
        self._paths: dict[str, tuple[PathPieces, Colour, float]] = {}
        self._latest: dict[str, tuple[int, int]] = {}
        self._plan = PlanSelection()
        self.colours: dict[str, Colour] = {}  # of estimators, by source
        self.images: dict[str, list[str]] = {}  # kinds of images there are, by camera's entity
        self.trails: list[str] = []  # entities to show with all logged data
        self.bounds = np.array([[np.inf] * 3, [-np.inf] * 3])  # lowest, highest (``map``, m)
        log.static(entities.WORLD, self._rr.ViewCoordinates.FRD)

    # Announced entities.

    def vehicle(self, source: str) -> None:
        """Prepare a vehicle: a body with four rotors, and its axes."""
        if source in self._truth:
            return
        self.vehicles.add(source)
        colour = truth_colour(len(self._truth))
        self._truth[source] = RecentPoses()
        entity = entities.world(source)
        self._entity_log.static(
            f"{entity}/shape",
            self._rr.Boxes3D(
                centers=[box.centre for box in VEHICLE],
                sizes=[box.size for box in VEHICLE],
                colors=[box.colour for box in VEHICLE],
                fill_mode="solid",
            ),
        )
        self._entity_log.static(entity, self._rr.TransformAxes3D(0.4))
        self._path(entities.world("truth", source), colour, _THICK)

    def estimator(self, source: str) -> None:
        """Prepare an estimator's path and colour."""
        if source in self.colours:
            return
        self.colours[source] = estimate_colour(len(self.colours))
        self._path(entities.world("estimates", source, "path"), self.colours[source], _THIN)

    def camera(self, announced: CameraAnnouncement) -> None:
        """Prepare a camera: mounting, and projection of its images."""
        config, info = self._config, announced.info
        self._cameras[announced.source] = announced
        self.vehicles.announced(announced)
        entity = self._entities[announced.source] = entities.camera(announced, list(self._truth))
        self._frames.setdefault(announced.frame_id, entity)
        kinds = [kind for kind in announced.images if config.depth or kind != "depth"]
        self.images[entity] = kinds if config.image_rate else []
        twin = entity.startswith(f"{self._frames[announced.frame_id]}/")  # undistorted images
        if announced.parent_frame_id != "map" and not twin:
            self._entity_log.static(
                entity, self._transform(announced.position, announced.orientation)
            )
        for kind in announced.images:
            self._pinhole(f"{entity}/{kind}", info, config.depth_stride if kind == "depth" else 1)
        if "depth" in announced.images and config.points_rate and config.image_rate:
            self._scene_points[announced.source] = ScenePoints(
                info,
                config.points_rate,
                config.points_stride,
                config.points_max_distance,
                config.points_max_height,
            )
            self.trails.append(entities.world("points", announced.source))

    def sensor(self, announced: ImuAnnouncement | SensorAnnouncement) -> None:
        """Prepare a sensor: mounting on its vehicle."""
        entity = entities.world(announced.source)
        if announced.frame_id != announced.parent_frame_id:
            self._entity_log.static(
                entity, self._transform(announced.position, announced.orientation)
            )

    def moving_body(self, announced: BodyAnnouncement) -> None:
        """Prepare a self-moving body, and its path."""
        box, entity = moving_body(announced.kind), entities.world(announced.source)
        shape = self._rr.Boxes3D(centers=[box.centre], sizes=[box.size], colors=[box.colour])
        self._entity_log.static(f"{entity}/shape", shape)
        self._path(entities.world("paths", announced.source), box.colour, _THIN)
        self._moving.add(announced.source)

    # Moving entities.

    def odometry(self, source: str, events: Sequence[Numbered[Odometry]]) -> None:
        """Log a vehicle's true poses."""
        self.vehicle(source)
        self._other_frames.setdefault(events[0][1].child_frame_id, entities.world(source))
        truth = self._truth[source]
        for number, event in events:
            truth.add(event.stamp, event.position, event.orientation)
            self._entity_log.now = number, event.stamp
            self._extend(entities.world("truth", source), event)
        positions = np.array([event.position for _, event in events])
        self.bounds[0] = np.minimum(self.bounds[0], positions.min(axis=0))
        self.bounds[1] = np.maximum(self.bounds[1], positions.max(axis=0))
        self._poses(entities.world(source), events)

    def estimates(self, source: str, events: Sequence[Numbered[PoseEstimate]]) -> None:
        """Log an estimator's poses, aligned unless in ``map``, as in the evaluation."""
        self.estimator(source)
        frame_entity = entities.world("estimates", source)
        first = events[0][1]
        if source not in self._anchored:
            self._anchored.add(source)
            if first.frame_id != "map":
                self._other_frames.setdefault(first.frame_id, frame_entity)
                truth = self._truth.get(self.vehicles.of(source))
                if (frame := estimate_frame(first, truth)) is not None:
                    self._entity_log.static(frame_entity, self._transform(*frame))
            self._entity_log.static(f"{frame_entity}/body", self._rr.TransformAxes3D(0.3))
        for number, event in events:
            self._entity_log.now = number, event.stamp
            self._extend(f"{frame_entity}/path", event)
        self._poses(f"{frame_entity}/body", events)

    def plan(self, event: Planned) -> None:
        """Log the planned position of a vehicle."""
        if self._plan.select(event):
            entity = entities.path(entities.PLAN, event.vehicle)
            self._path(entity, PLAN, _THIN)
            self._extend(entity, event)

    def wind(self, source: str, events: Sequence[Numbered[Wind]]) -> None:
        """Log the wind as an arrow at its vehicle, some times a second: a metre for each m/s."""
        vehicle = source.rpartition("/")[2]
        for number, event in events:
            pose = self._truth[vehicle].at(event.stamp) if vehicle in self._truth else None
            if pose is not None and event.stamp >= self._wind_due.get(vehicle, 0):
                self._wind_due[vehicle] = event.stamp + _WIND_PERIOD
                self._entity_log.now = number, event.stamp
                arrow = self._rr.Arrows3D(
                    origins=[pose[0]], vectors=[event.velocity], colors=[WIND], radii=[_THICK]
                )
                self._entity_log.add(entities.world("wind", vehicle), arrow)

    def pose(self, event: PoseStamped) -> None:
        """Log the pose of a free camera or self-moving body, or of a camera, for depth images."""
        if event.source in self._moving:
            entity = entities.world(event.source)
            self._entity_log.add(entity, self._transform(event.position, event.orientation))
            self._extend(entities.world("paths", event.source), event)
            return
        camera = self._cameras.get(event.source)
        if camera is not None and camera.parent_frame_id == "map":
            pose = self._transform(event.position, event.orientation)
            self._entity_log.add(self._entities[event.source], pose)
        self._extend_scene(event)

    # Images, features and point clouds.

    def image(self, event: Image) -> None:
        """Log an image."""
        image = self._rr.Image(event.data)
        if quality := self._config.jpeg_quality:
            code = encode_image(event.data, "jpeg", quality).tobytes()
            image = self._rr.EncodedImage(contents=code, media_type="image/jpeg")
        self._entity_log.add(self._place(event, "grey" if event.data.ndim == 2 else "rgb"), image)
        self._extend_scene(event)

    def depth(self, event: DepthImage) -> None:
        """Log a depth image."""
        if (config := self._config).depth:
            pixels = event.data[:: config.depth_stride, :: config.depth_stride]
            image = self._rr.EncodedDepthImage(
                encode_depth(depth_in_steps(pixels, CENTIMETRES)),
                media_type="image/png",
                meter=CENTIMETRES,
                colormap="turbo",
                depth_range=(0.0, config.points_max_distance * CENTIMETRES),
            )
            self._entity_log.add(self._place(event, "depth"), image)
        self._extend_scene(event)

    def segmentation(self, event: SegmentationImage) -> None:
        """Log a segmentation image; class 0 is no object."""
        classes = np.clip(event.data + 1, 0, 65535).astype(np.uint16)
        self._entity_log.add(
            self._place(event, "segmentation"), self._rr.SegmentationImage(classes)
        )

    def features(self, event: TrackedFeatures) -> None:
        """Log an estimator's tracked features of an image."""
        if (camera := self._frames.get(event.frame_id)) is not None:
            colours = np.where(event.inliers[:, None], INLIER, OUTLIER).astype(np.uint8)
            centres = event.points + 0.5  # Rerun's pixels have their centres at halves
            points = self._rr.Points2D(centres, colors=colours, radii=2.0)
            entity = entities.path("features", event.source)
            kind = "rgb" if "rgb" in self.images[camera] else "grey"
            self._entity_log.add(f"{camera}/{kind}/{entity}", points)

    def cloud(self, event: PointCloud) -> None:
        """Log a cloud, in the world or below the owner of its frame."""
        entity = entities.world("clouds", event.source)
        for frames in (self._other_frames, self._frames):
            if (owner := frames.get(event.frame_id)) is not None:
                entity = f"{owner}/{entities.path('cloud', event.source)}"
        colours = event.colors if len(event.colors) else None
        self._entity_log.add(entity, self._rr.Points3D(event.points, colors=colours, radii=0.02))

    def scan(self, event: LidarScan) -> None:
        """Log a turn of a lidar, brighter where more light came back."""
        grey = (55.0 + 200.0 * np.clip(event.intensities, 0.0, 1.0)).astype(np.uint8)
        colours = np.stack([grey, grey, np.full_like(grey, 255)], axis=1)
        entity = f"{entities.world(event.source)}/points"
        self._entity_log.add(entity, self._rr.Points3D(event.points, colors=colours, radii=0.02))

    def finish(self) -> None:
        """Log the remaining points of the paths."""
        for entity, (path, _, _) in self._paths.items():
            if (remaining := path.rest()) is not None:
                self._entity_log.now = self._latest[entity]
                self._strip(entity, remaining)

    def _place(self, event: Image | DepthImage | SegmentationImage, kind: str) -> str:
        """Return an image's entity: below its camera, or by itself if the camera is unannounced."""
        camera = self._entities.get(event.source)
        if camera is None:  # grey images of a camera with colours, or nobody's
            camera = self._frames.setdefault(event.frame_id, entities.path("images", event.source))
        if kind not in (kinds := self.images.setdefault(camera, [])):
            kinds.append(kind)
        return f"{camera}/{kind}"

    def _extend_scene(self, event: Image | DepthImage | PoseStamped) -> None:
        scene = self._scene_points.get(event.source)
        if scene is not None and (new := scene.add(event)) is not None:
            points = self._rr.Points3D(new.points, colors=new.colours, radii=0.02)
            self._entity_log.add(entities.world("points", event.source), points)

    def _pinhole(self, entity: str, info: CameraInfo, stride: int) -> None:
        """Log the pinhole model of an image of every n-th pixel; Rerun's centres are at halves."""
        matrix = info.matrix()
        matrix[:2] /= stride
        matrix[:2, 2] += 0.5
        self._entity_log.static(
            entity,
            self._rr.Pinhole(
                image_from_camera=matrix,
                resolution=(-(-info.width // stride), -(-info.height // stride)),
                camera_xyz=self._rr.ViewCoordinates.RDF,
                image_plane_distance=0.5,
                color=(200, 200, 210),
            ),
        )

    def _poses(
        self, entity: str, events: Sequence[Numbered[Odometry]] | Sequence[Numbered[PoseEstimate]]
    ) -> None:
        columns = self._rr.Transform3D.columns(
            translation=np.array([event.position for _, event in events]),
            quaternion=np.array(
                [(*event.orientation[1:], event.orientation[0]) for _, event in events]
            ),
        )
        self._entity_log.columns(entity, events, columns)

    def _transform(self, position: Vector3, orientation: tuple[float, ...]) -> object:
        w, x, y, z = orientation
        return self._rr.Transform3D(translation=position, quaternion=(x, y, z, w))

    def _path(self, entity: str, colour: Colour, radius: float) -> None:
        if entity not in self._paths:
            self._paths[entity] = PathPieces(), colour, radius
            self.trails.append(entity)

    def _extend(self, entity: str, event: Odometry | PoseEstimate | PoseStamped | Planned) -> None:
        self._latest[entity] = self._entity_log.now
        if (piece := self._paths[entity][0].add(event.stamp, event.position)) is not None:
            self._strip(entity, piece)

    def _strip(self, entity: str, piece: list[Vector3]) -> None:
        _, colour, radius = self._paths[entity]
        self._entity_log.add(
            entity, self._rr.LineStrips3D([piece], colors=[colour], radii=[radius])
        )
