"""ORB-SLAM3 as a node, and by `pyorbslam3` in a worker's process: under the GPL, able to crash.

    slam = await self.worker(OrbSlam3Process, settings, vocabulary, latency=…)
    result = await slam.call(OrbSlam3Process.track, stamp, image, depth)
    stamps, poses = await slam.call(OrbSlam3Process.trajectory)

The library is imported when an object is made, so that others may import this module for its
names. It prints much, to standard output, which a worker gathers.

`Anchor` gives one frame to all of ORB-SLAM3's maps, whose own frames it rotates, scales and merges.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from events import DepthImage, Image, Imu
from events.geometry import pose_matrix
from nodes.estimators import (
    Estimator,
    EstimatorConfig,
    MonocularFrame,
    MonocularInertialFrame,
    RgbdFrame,
    RgbdInertialFrame,
    StereoFrame,
    StereoInertialFrame,
    TrackingResult,
    sample_rows,
)
from runtime import Bundle, Duration
from runtime.errors import MissingDependencyError
from runtime.node import CommandLine
from runtime.paths import InputPath
from visnav_estimators.orb_slam3.settings import (
    LENSES,
    Mode,
    OrbSettings,
    Settings,
    TreeShape,
    cached_vocabulary,
    check_vocabulary,
    find_vocabulary,
    make_settings,
)

Floats = npt.NDArray[np.float64]


class KeyFrame(NamedTuple):
    """A key frame of the present map."""

    stamp: float  # seconds, to a microsecond; tells key frames apart
    pose: Floats  # the camera in ORB-SLAM3's world now, shape (4, 4)


class Anchor:
    """Converter of poses from ORB-SLAM3's worlds to the frame of the very first key frame.

    ORB-SLAM3's world is that of its present map: after a long loss it starts another one at
    identity, at a known place it merges the two, and with the IMU's scale and gravity it turns the
    world upright. The map's first key frame stays; its present pose is read whenever the world may
    have changed. A map after a loss is put at the camera's last known pose: the motion in between
    is missing until a merge.
    """

    def __init__(self) -> None:
        self._first: dict[float, Floats] = {}  # first key frames of all maps, in our frame
        self._from_world = np.eye(4)
        self.last = np.eye(4)  # the last known pose; identity before the first
        self._doubted = False
        self._map = 0.0  # stamp of its first key frame

    @property
    def maps(self) -> int:
        """Return how many maps there have been."""
        return len(self._first)

    @property
    def map(self) -> int:
        """Number of the map in use; 0 before the first."""
        return list(self._first).index(self._map) if self._first else 0

    def world_may_have_changed(self, first: KeyFrame, pose: Floats) -> None:
        """Record the present map's first key frame; `pose` is the camera in that map, (4, 4)."""
        is_known = first.stamp in self._first
        if not is_known:
            first_in_camera = np.linalg.inv(pose) @ first.pose  # first key frame in the camera now
            self._first[first.stamp] = self.last @ first_in_camera if self._first else np.eye(4)
        from_world = self._first[first.stamp] @ np.linalg.inv(first.pose)
        # The world may turn between the moment of the pose and that of the key frame's: then the
        # old one fits this pose, and the new one the next.
        old_fits = self._jump(self._from_world, pose) < self._jump(from_world, pose)
        self._doubted = is_known and old_fits and not self._doubted
        if not self._doubted:
            self._from_world, self._map = from_world, first.stamp

    def _jump(self, from_world: Floats, pose: Floats) -> float:
        return float(np.linalg.norm((from_world @ pose)[:3, 3] - self.last[:3, 3]))

    def first(self, stamp: float) -> tuple[int, Floats] | None:
        """Return a map's number and its first key frame in our frame, by the stamp."""
        entries = enumerate(self._first.items())
        return next(((n, pose) for n, (at, pose) in entries if abs(at - stamp) < 1e-4), None)

    def place(self, pose: Floats) -> Floats:
        """Return a pose in the very first key frame's frame; kept as the last pose."""
        self.last = self._from_world @ pose
        return self.last


def first_key_frame(trajectory: Path) -> KeyFrame | None:
    """Return the first pose of a TUM trajectory; `None` if empty."""
    with trajectory.open(encoding="ascii") as lines:
        fields = lines.readline().split()
    if len(fields) != 8:
        return None
    stamp, x, y, z, qx, qy, qz, qw = map(float, fields)
    return KeyFrame(stamp, pose_matrix((x, y, z), (qw, qx, qy, qz)))


Points = npt.NDArray[np.float32]

INSTALL = (
    "make orbslam3, or: pip install './extensions/estimators[orbslam3]', on Debian and Ubuntu "
    "apt-get install libgl1 libegl1 libopengl0 libsm6 libice6 libx11-6 libxext6, and then "
    "python -m runtime vocabulary config.toml"
)  # installation of ORB-SLAM3 with its vocabulary; `make` serves in a checkout

_REACH = 6.0  # largest distance of a projected map point from its corner, pixels


class OrbSlam3Result(TrackingResult, frozen=True, eq=False):
    """Result of ORB-SLAM3 for an image.

    The pose is in the optical camera at the first key frame; points are all undistorted corners,
    inliers those that agree with the map.
    """

    # ORB-SLAM3's own word (OK, NOT_INITIALIZED, RECENTLY_LOST, LOST, …), or RESET for a map just
    # discarded.
    state: str = ""
    matches: int = 0  # number of map points found
    first_keyframe: int = -1  # stamp of the first key frame (ns); -1 before there is one
    maps: int = 0  # number of maps so far; see `Anchor`


class OrbSlam3Process:
    """ORB-SLAM3 with its threads: tracking in `track`, mapping in the background.

    Args:
        settings: Mode, settings file, size of images.
        vocabulary: In DBoW2's text format, its name ending with ``.txt``.
        mapping_time: Processor seconds that `track` leaves to the other threads, at most, after
            each image. Without any, images faster than real time make the map poorer.

    Raises:
        MissingDependencyError: `pyorbslam3` cannot be imported.
        ValueError: The vocabulary is none.
    """

    def __init__(self, settings: Settings, vocabulary: Path, mapping_time: float = 1.0) -> None:
        try:
            import pyorbslam3
        except ImportError as error:  # also where one of the system's libraries is missing
            raise MissingDependencyError(
                f"ORB-SLAM3 needs pyorbslam3 ({error}): {INSTALL}"
            ) from error
        check_vocabulary(vocabulary)
        self._settings, self._mapping_time = settings, mapping_time
        self._left_alone = time.process_time()
        self._anchor = Anchor()
        self._was_ok = self._new = False
        self._stamps: list[int] = []
        self._ahead = np.empty((0, 7))  # measurements later than the last image
        self._first_keyframe = -1
        self._folder = tempfile.TemporaryDirectory(prefix="orb_slam3_")
        file = Path(self._folder.name) / "settings.yaml"
        file.write_text(settings.text, encoding="ascii")
        self._slam: Any = pyorbslam3.Slam(
            vocabulary, file, getattr(pyorbslam3.Sensor, _SENSORS[settings.mode]), use_viewer=False
        )

    def track(
        self,
        stamp: int,  # of the exposure (ns), rising
        image: npt.NDArray[np.uint8],
        depth: npt.NDArray[np.float32] | None = None,
        right: npt.NDArray[np.uint8] | None = None,  # the right image, for stereo modes only
        imu: Floats | None = None,
    ) -> OrbSlam3Result:
        """Return the pose of the next image.

        Args:
            image: Shape (h, w, 3) red, green, blue, or (h, w) grey; of a stereo rig the left one.
            depth: Metres along the optical axis, shape (h, w); ``inf`` for none. For modes with
                depth only.
            imu: For inertial modes: measurements since the last call, shape (n, 7): stamp (ns),
                angular velocity (rad/s), specific force (m/s²). Those after it wait for the next.

        Raises:
            ValueError: An array is missing, superfluous, or of the wrong shape.
        """
        check_arrays(self._settings, image, depth, right, imu)
        self._stamps.append(stamp)
        # The second image of a map is compared with the first key frame by its words, which another
        # thread must have found by now: if not, it is lost at once.
        share = max(_FIRST if self._new else 0.0, self._mapping_time)
        wait_for_other_threads(self._left_alone + share)
        chunk = None
        if imu is not None:
            imu = np.vstack([self._ahead, imu])
            later = imu[:, 0] > stamp
            self._ahead, chunk = imu[later], imu[~later] * (1e-9, 1, 1, 1, 1, 1, 1)
        if depth is not None:
            # 0 is how ORB-SLAM3 knows that there is no depth.
            finite_depth = np.where(np.isfinite(depth), depth, np.float32(0))
            result = self._slam.track_rgbd(image, finite_depth, stamp * 1e-9, chunk)
        elif right is not None:
            result = self._slam.track_stereo(image, right, stamp * 1e-9, chunk)
        else:
            result = self._slam.track_monocular(image, stamp * 1e-9, chunk)
        tracked = self._result(result)
        self._left_alone = time.process_time()
        return tracked

    def trajectory(self) -> tuple[npt.NDArray[np.int64], Floats, int]:
        """End ORB-SLAM3's threads; return the poses of its largest map after all corrections.

        Returns:
            Stamps as given to `track`, strictly rising, shape (n,), the optical camera in the frame
            of `track`'s poses, shape (n, 4, 4), and the number of that map.
        """
        wait_for_other_threads(self._left_alone + _LAST)
        self._slam.shutdown()
        folder = Path(self._folder.name)
        files = str(folder / "frames.txt"), str(folder / "key_frames.txt")
        self._slam.save_trajectory_euroc(files[0])
        self._slam.save_keyframe_trajectory_euroc(files[1])
        rows, key_frames = (np.loadtxt(file, ndmin=2) for file in files)
        first = self._anchor.first(key_frames[0, 0] * 1e-9) if len(key_frames) else None
        if first is None or not len(rows):
            return np.empty(0, np.int64), np.empty((0, 4, 4)), 0
        number, first_pose = first
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, 3] = rows[:, 1:4]
        poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
        on_imu = self._settings.camera_on_imu  # with an IMU, poses are those of its frame
        poses = first_pose @ np.linalg.inv(on_imu) @ poses @ on_imu
        sent = np.array(self._stamps)
        at = np.abs(sent - np.round(rows[:, :1])).argmin(1)
        at, row = np.unique(at, return_index=True)
        return sent[at], poses[row], number

    def close(self) -> None:
        """End ORB-SLAM3's threads."""
        if not self._slam.is_shutdown():
            self._slam.shutdown()
        self._folder.cleanup()

    def _result(self, result: Any) -> OrbSlam3Result:
        state = result.state.name
        valid = result.pose_valid and (state != "RECENTLY_LOST" or self._slam.imu_initialized())
        if valid and self._was_ok and np.array_equal(result.pose_wc, np.eye(4)):
            # What it returns when it throws its map away; only a map's first pose is this one.
            valid, state = False, "RESET"
        corners = self._slam.tracked_keypoints()
        inliers = np.zeros(len(corners), np.bool_)
        reason = _REASONS.get(state, state)
        tracked, mode = valid, self._settings.mode
        if mode == "monocular_inertial" and tracked and not self._slam.imu_initialized():
            valid, reason = False, "the IMU has not given the scale yet"
        if valid:
            pose = np.asarray(result.pose_wc, np.float64)
            before = self._anchor.maps
            if not self._was_ok or before > 1 or self._slam.inertial:
                self._update_map(pose)  # (it does not say when it has merged two)
            self._anchor.place(pose)
            reason = ""
            if self._anchor.maps > before > 0:
                reason = "a new map, put where the camera was last known to be"
            points = self._slam.tracked_map_points()
            if len(points) and len(corners):
                inliers[self._match_corners(points, pose, corners)] = True
        self._new, self._was_ok = tracked and not self._was_ok, tracked
        return OrbSlam3Result(
            pose=self._anchor.last,
            lost=not valid,
            reason=reason,
            state=state,
            points=corners,
            inliers=inliers,
            matches=int(result.num_tracked_points) if valid else 0,
            first_keyframe=self._first_keyframe,
            maps=self._anchor.maps,
            map=self._anchor.map,
        )

    def _update_map(self, pose: Floats) -> None:
        """Read the present map's first key frame, available only from its trajectory."""
        file = Path(self._folder.name) / "key_frames.tum"
        self._slam.save_keyframe_trajectory_tum(str(file))
        first = first_key_frame(file)
        if first is not None:
            self._anchor.world_may_have_changed(first, pose)
            if self._first_keyframe < 0:
                nearest = np.abs(np.array(self._stamps) - first.stamp * 1e9).argmin()
                self._first_keyframe = self._stamps[nearest]

    def _match_corners(
        self, points: Points, pose: Floats, corners: Points
    ) -> npt.NDArray[np.int64]:
        """Return the corners matched to map points (n, 3) of ORB-SLAM3's world."""
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        ahead = in_camera[in_camera[:, 2] > 0]
        fx, fy, cx, cy = self._settings.intrinsics
        pixels = ahead[:, :2] / ahead[:, 2:] * (fx, fy) + (cx, cy)
        distance, corner = KDTree(corners).query(pixels)
        return np.asarray(corner[distance < _REACH], np.int64)


def check_arrays(
    settings: Settings,
    image: npt.NDArray[np.uint8],
    depth: npt.NDArray[np.float32] | None,
    right: npt.NDArray[np.uint8] | None,
    imu: Floats | None,
) -> None:
    """Raise a `ValueError` for arrays that ORB-SLAM3 would exit on, or silently misread."""
    mode, size = settings.mode, (settings.height, settings.width)
    for name, array, part, shapes in (
        ("image", image, "", (size, (*size, 3))),
        ("depth", depth, "rgbd", (size,)),
        ("right", right, "stereo", (size, (*size, 3))),
        ("imu", imu, "inertial", ((len(imu) if imu is not None else 0, 7),)),
    ):
        if (array is not None) != (part in mode):
            expected, actual = ("an array", "none") if array is None else ("none", "an array")
            raise ValueError(f"{name}: mode {mode!r} expects {expected}, found {actual}")
        if array is not None and array.shape not in shapes:
            raise ValueError(
                f"{name}: expected shape {' or '.join(map(str, shapes))}, found {array.shape}"
            )


def wait_for_other_threads(until: float) -> None:
    """Return when the other threads, polling every 3 and 5 ms, rest, or at a `process_time`."""
    quiet, naps = 0, _naps()
    while quiet < 3 and time.process_time() < until:
        start = time.process_time() - time.thread_time()  # of the others
        time.sleep(_QUIET)
        before, naps = naps, _naps()
        # Who computes, or runs (or waits for a processor) without a nap, has something to do.
        busy = time.process_time() - time.thread_time() - start > _QUIET / 5
        busy |= any(runs and before.get(task) == (runs, n) for task, (runs, n) in naps.items())
        quiet = 0 if busy else quiet + 1


def _naps() -> dict[str, tuple[bool, str]]:
    """Return by thread id, for all other threads, whether running, and waits so far."""
    threads = {}
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has ended
            status = (task / "status").read_text(encoding="utf-8", errors="replace")
            fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
            if task.name != str(threading.get_native_id()):
                runs = fields["State"][0] in "RD"
                threads[task.name] = runs, fields["voluntary_ctxt_switches"]
    return threads


_QUIET = 0.0025  # seconds between two looks; three are longer than the threads' naps
_FIRST = 1.0  # seconds of computing for the other threads after the first image of a map
_LAST = 10.0  # seconds of computing for the other threads after the last image
_SENSORS = {
    "rgbd": "RGBD",
    "monocular": "MONOCULAR",
    "stereo": "STEREO",
    "rgbd_inertial": "IMU_RGBD",
    "monocular_inertial": "IMU_MONOCULAR",
    "stereo_inertial": "IMU_STEREO",
}

_REASONS = {
    "SYSTEM_NOT_READY": "not ready yet",
    "NO_IMAGES_YET": "a new map has not been initialized yet",
    "NOT_INITIALIZED": "the map has not been initialized yet",
    "RESET": "the map has been discarded: it did not give the IMU's scale or gravity",
    "RECENTLY_LOST": "too few matches with the map; looking for a place seen before",
    "LOST": "too few matches with the map",
}  # meanings of ORB-SLAM3's states, for the log


class Frame(NamedTuple):
    """Fields read in any mode."""

    image: Image
    depth: DepthImage | None
    left: Image | None
    right: Image | None
    imu: Imu | None


_FRAMES: dict[Mode, type[tuple[Any, ...]]] = {
    "rgbd": RgbdFrame,
    "monocular": MonocularFrame,
    "stereo": StereoFrame,
    "rgbd_inertial": RgbdInertialFrame,
    "monocular_inertial": MonocularInertialFrame,
    "stereo_inertial": StereoInertialFrame,
}


class OrbSlam3Config(EstimatorConfig):
    """Settings of ORB-SLAM3.

    Attributes:
        mode: The sensors used.
        vocabulary: File in DBoW2's text format; if empty, that of ``python -m runtime vocabulary
            CONFIG``.
        orb: ORB-SLAM3's own settings.
        mapping_timeout: Processor time of its other threads after each image, at most, in lockstep:
            the next one waits until they rest. On the real clock only a map's second one does.
    """

    mode: Mode = "rgbd"
    vocabulary: InputPath = ""
    orb: OrbSettings = OrbSettings()
    mapping_timeout: Duration = Duration(1.0)  # immutable


class OrbSlam3(Estimator[OrbSlam3Config]):
    """Estimator of a camera's pose by ORB-SLAM3, in a process of its own.

    Because of its threads the results vary from run to run, and so does the digest.
    """

    deterministic: ClassVar[bool] = False
    library = "pyorbslam3", INSTALL

    frames = Bundle(Frame, keep="latest")

    @classmethod
    def made_from(cls, config: OrbSlam3Config) -> Iterable[Path | CommandLine]:
        """Return the vocabulary that the settings leave out."""
        if not config.vocabulary:
            yield cached_vocabulary(TreeShape())

    def __init__(self) -> None:
        mode = self.config.mode
        self.needs = frozenset({"grey", "depth"} if "rgbd" in mode else {"grey"})
        self.eyes = 2 if "stereo" in mode else 1
        self.inertial = "inertial" in mode
        self.lenses = LENSES[mode.removesuffix("_inertial")]
        self.method = f"ORB-SLAM3 ({mode.replace('_', ', ')})"
        self.scale_free = mode == "monocular"
        self.read(_FRAMES[mode])
        self._slam: Any = None

    def check(self) -> Iterable[str]:
        """Return the errors: no camera, an IMU on another body, or no vocabulary."""
        missing = [*super().check()]
        yield from missing
        if missing:
            return
        config = self.config
        if not config.orb.loop_closing:
            yield (
                "orb.loop_closing: expected true, found false: without it ORB-SLAM3 crashes soon "
                "after its map has begun (seen with pyorbslam3 0.1.1)"
            )
        try:
            self._settings = make_settings(
                config.mode, self.cameras, self.imu_announcement, config.orb
            )
            self._vocabulary = find_vocabulary(config.vocabulary)
        except ValueError as error:
            yield str(error)

    async def on_ready(self) -> None:
        """Start ORB-SLAM3, in a process of its own."""
        mapping = float(self.config.mapping_timeout) if self.clock.kind == "lockstep" else 0.0
        arguments = self._settings, self._vocabulary, mapping
        self._slam = await self.worker(OrbSlam3Process, *arguments, latency=self.config.latency)

    async def run(self) -> None:
        """Track each image; images arriving meanwhile are skipped."""
        initialized = False
        async for frame in self.frames:
            images = frame._asdict()
            image = frame[0]
            result = await self._slam.call(
                OrbSlam3Process.track,
                self.exposed_at(image),
                image.data,
                images["depth"].data if "depth" in images else None,
                images["right"].data if "right" in images else None,
                sample_rows(images["imu"]) if "imu" in images else None,
            )
            initialized = initialized or not result.lost
            if initialized:
                first = result.first_keyframe
                self.publish(image, result, origin=first if first >= 0 else None)

    async def on_end(self) -> None:
        """Send the trajectory after loop closures and other corrections, if it can be saved."""
        if self._slam is None:  # another node failed to start
            return
        try:
            self.publish_trajectory(*await self._slam.call_for(0.0, OrbSlam3Process.trajectory))
        except RuntimeError as error:  # of its library: what it said in flight is judged
            self.log.warning("ORB-SLAM3 failed to save its final trajectory: %s", error)
