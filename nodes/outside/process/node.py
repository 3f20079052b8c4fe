"""External program as a node: started with the run, fed with images, ended with the run."""

from __future__ import annotations

import asyncio
import contextlib
import math
import types
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from events import Announcement, CameraAnnouncement, DepthImage, Image, Imu, ImuAnnouncement
from nodes.calibration.formats import variables
from nodes.data.dataset.recording import Rig
from nodes.estimators import Estimator, TrackingResult
from nodes.outside.native import LinkAnswer, LinkError, describe
from nodes.outside.native.client import SAMPLE
from nodes.outside.process.launch import Launch, ProcessConfig, ProgramError
from nodes.outside.process.program import KINDS, Feed, Program
from nodes.ros2.messages.mappings import TopicKind, publication
from nodes.ros2.messages.topics import PublishingConfig
from runtime import Node, on
from runtime.channels.bundles import Field, Matcher, Slot
from runtime.channels.hold import Hold, Owed
from runtime.channels.streams import Stream
from runtime.workers.output import Throttle

_BEYOND = 64
"""Waiting frames beyond the slots, in lockstep with `on_missing = "continue"`."""

_STORY = 0.5
"""Real seconds to wait for a program's exit code after its connection has closed."""


_TOGETHER: Any = types.SimpleNamespace(_make=tuple)
"""Bundle type for a `Matcher`: a tuple of the images of a stamp."""


class Process(Estimator[ProcessConfig]):
    """External program of any language as an estimator, judged unchanged.

    ::

        [[nodes]]
        name = "slam"
        type = "Process"
        command = ["./my_slam", "$VISNAV_FOLDER/settings.yaml"]
        folder = "."
        latency = "15ms"

        [[nodes.files]]
        path = "settings.yaml"
        template = "settings.yaml.jinja"

    The program and all its processes end with the run, however the run ends. If it ends before, the
    error has its exit code and last lines, and `hold` says what becomes of the run.
    """

    starts_programs = True

    def __init__(self) -> None:
        config = self.config
        self.needs = frozenset(config.images)
        self.scale_free = config.scale_free
        self.method = config.method or (Path(config.command[0]).name if config.command else "")
        self._named: dict[str, CameraAnnouncement] = {}
        self._imus: list[ImuAnnouncement] = []
        self._samples: deque[Imu] = deque(maxlen=100_000)
        self._slots: dict[tuple[str, type], Slot] = {}
        self._feed: Feed | None = None
        self._program: Program | None = None
        self._connected = self._closing = False
        self._pose: npt.NDArray[np.float64] = np.eye(4)
        self._unsent = 0
        found = (s.config for s in self.siblings(Node) if isinstance(s.config, PublishingConfig))
        self._bridge = next((each for each in found if hasattr(each, "domain_id")), None)
        folder = None if self.out is None else self.out / "programs" / self.name
        self._show = Throttle(lambda line: self.log.info("%s", line))
        self._launch = Launch(config, self._bridge if config.feed == "ros2" else None, folder)

    # Before the run.

    async def on_startup(self) -> None:
        """Create the program's folder, and run the build command."""
        if self.checking:
            return
        await self.offload(self._launch.make_folder, anew=not self.restarts)
        try:
            await self._build()
        except BaseException:
            self._launch.close()
            raise

    async def _build(self) -> None:
        if not (command := self.config.build):
            return
        if missing := self._launch.missing("build", command):
            raise ProgramError(missing)
        show = Throttle(lambda line: self.log.info("build: %s", line))
        build = self._launch.start(command, show)
        try:
            await self.offload(build.wait)
        finally:  # of a run that is to end, too
            build.leave()
            show.end()
        if build.code != 0:
            raise ProgramError(f"build: {' '.join(command)} {build.story()}")

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates, if they come from here."""
        return super().announce() if self.config.feed == "link" else ()

    def on_announcement(self, announcement: Announcement) -> None:
        """Choose the cameras, and note the IMUs."""
        if isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)
        names = self.config.cameras
        if names and isinstance(announcement, CameraAnnouncement):
            path = f"/{announcement.source}"
            name = next((name for name in names if path.endswith(f"/{name}")), "")
            if name not in names or name in self._named:
                return
            self._named[name] = announcement
            if name != names[0]:
                return
        super().on_announcement(announcement)
        if names:
            self.sources.pop("frames", None)  # those of the others are wanted, too

    def check(self) -> Iterable[str]:
        """Yield an error for each missing camera, bridge, program or template."""
        config = self.config
        if config.feed == "ros2" and self._bridge is None:
            yield 'feed: expected a Ros2Bridge in the file for "ros2", found none'
        if config.feed == "link":
            yield from super().check()
            for name in config.cameras:
                given = {*self._named[name].images} if name in self._named else set()
                if lacking := self.needs - given - ({"grey"} if "rgb" in given else set()):
                    kinds = ", ".join(sorted(lacking))
                    yield f"cameras: expected {kinds} images of {name}, found none"
            frames = config.latency * self.camera.rate if self.camera else 2.0
            if config.hold.skips == "allowed" and frames <= 1.0 and self.clock.kind == "lockstep":
                yield (
                    'hold.skips: expected a latency above the camera\'s period with "allowed": no '
                    "later frame goes out while time waits for this one"
                )
        what = "build" if self.checking and config.build else "command"  # built later
        if words := getattr(config, what):
            yield from filter(None, [self._launch.missing(what, words)])
        try:
            self._launch.texts(self._known())
        except ProgramError as error:
            yield str(error)

    async def on_ready(self) -> None:
        """Write the files, start the program, and wait for its connection."""
        config, launch = self.config, self._launch
        self._loop = asyncio.get_running_loop()
        self._end: asyncio.Future[str] = self._loop.create_future()
        for path, text in launch.texts(self._known()).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            await self.offload(path.write_text, text, "utf-8")
        if config.feed == "link":
            self._feed = self._make_feed()
        if config.command:
            start = self.offload(launch.start, config.command, self._show, self._note_end)
            self._program = await start
        else:
            self.log.warning("start the program with VISNAV_SOCKET=%s", launch.socket)
        if self._feed is None:
            return
        try:
            name = await self.offload(self._feed.connect, float(config.timeout))
        except LinkError as error:
            over = self._program is not None and self._program.wait(0)
            raise ProgramError(
                self._story("it has not connected" if over else str(error))
            ) from None
        self._connected = True
        self._hold.answers.costs.measure(0, self._processes())  # its start is for no frame
        self.log.info("%s is connected", name)

    def _make_feed(self) -> Feed:
        """Create the feed of the program, and the hold for its answers."""
        config, rig = self.config, self._rig()
        assert rig is not None
        if rig.imu is not None:
            self.narrow("imu", rig.imu.source)
        kinds = [KINDS[kind][0] for kind in config.images]
        self._wanted = [(number, kind) for number, _ in enumerate(rig.cameras) for kind in kinds]
        sources = [_source(camera, kind) for camera in rig.cameras for kind in config.images]
        fields = {f"image{n}": Field(event, "one") for n, (_, event) in enumerate(sources)}
        self._matcher = Matcher(Stream(f"{self.name}.frames", 1, "error"), _TOGETHER, fields, 0)
        self._matcher.deliver = self._send
        self._slots = dict(zip(sources, self._matcher.slots.values(), strict=True))
        self._hold: Hold[LinkAnswer] = self.hold(self.name, config.hold, config.latency)
        real = self.clock.kind == "real"
        slots = math.ceil(config.latency * rig.cameras[0].rate) + 2
        self._room = slots if real else math.inf
        if config.hold.on_missing == "continue" and not real:
            self._room = slots + _BEYOND
        pixels = sum(camera.info.height * camera.info.width for camera in rig.cameras)
        return Feed(
            self._launch.socket,
            describe([(c, kinds) for c in rig.cameras], rig.imu, {"kind": self.clock.kind}),
            self._hold,
            self._story,
            self._processes,
            skips=config.hold.skips == "allowed" or real,
            slots=slots,
            slot_bytes=pixels * sum(KINDS[kind][1] for kind in config.images),
            logged=self._show.take,
        )

    # In the run.

    async def run(self) -> None:
        """Raise `ProgramError` when a program fed by ROS 2 ends."""
        if self.config.feed == "ros2":
            raise ProgramError(await self._end)

    @on(Imu)
    def imu(self, event: Imu) -> None:
        """Keep the samples of the IMU until the next frame."""
        if "imu" in self.sources:
            self._samples.append(event)

    @on(Image, DepthImage)
    def frames(self, event: Image | DepthImage) -> None:
        """Put the images of an exposure together; once all are there, they are sent."""
        slot = self._slots.get((event.source, type(event)))
        if slot is not None:
            slot.take(event)

    def _send(self, images: tuple[Image | DepthImage, ...]) -> None:
        """Send an exposure, with the samples since the last, and await the answer."""
        assert self._feed is not None
        owed = self._hold.owe(images[0].stamp)
        if not self._hold.expects or len(self._feed.unanswered) >= self._room:
            self._unsent += 1
            return
        rows = [(s.stamp, s.angular_velocity, s.linear_acceleration) for s in self._samples]
        self._samples.clear()
        exposure = [(*wanted, image) for wanted, image in zip(self._wanted, images, strict=True)]
        self._feed.send(exposure, np.array(rows, SAMPLE))
        self.start(self._deliver(images[0], owed))

    async def _deliver(self, image: Image | DepthImage, owed: Owed[LinkAnswer]) -> None:
        """Publish the program's answer to a frame."""
        answer = await owed
        if answer is None:
            return
        lost = answer.pose is None
        self._pose = self._pose if answer.pose is None else answer.pose
        reason = "the program says so" if lost else ""
        found = answer.points, answer.inliers, answer.velocity, answer.covariance
        self.publish(image, TrackingResult(self._pose, lost, reason, *found))

    # After the run.

    async def on_shutdown(self) -> None:
        """Close the connection, and end the program if still running."""
        if self._unsent:
            self.log.warning(
                "%d frames were not sent: the program was gone or had no room", self._unsent
            )
        if missed := sum(self._matcher.missed.values()) if self._slots else 0:
            self.log.warning("%d exposures lacked an image", missed)
        await self.offload(self._close)

    def _close(self) -> None:
        self._closing = True
        if self._feed is not None:
            self._feed.close()
        if self._program is not None:
            if self._connected and self._program.wait(self.config.grace) and self._program.code:
                self.log.warning("%s %s", self.config.command[0], self._program.story())
            self._program.close()
        self._show.end()
        self._launch.close()

    # What is known of the program, in any thread.

    def _processes(self) -> list[int]:
        return [] if self._program is None else self._program.processes()

    def _note_end(self, story: str) -> None:
        """Report the program's end before the run's."""
        if self._closing:  # as it was told
            return
        story = f"{self.config.command[0]} {story}"
        if self._feed is not None:
            self._hold.gone("; ".join(filter(None, [self._feed.why_gone, story])))
            if not self._connected:
                self._feed.close()
        elif self._ends_the_run():
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._end.set_result, story)
        else:
            self.log.warning("%s", story)

    def _ends_the_run(self) -> bool:
        """Tell whether the bridge depends on the program's answers."""
        held = [each.hold for each in getattr(self._bridge, "subscriptions", ()) if each.answers_to]
        return not held or any(hold.on_missing == "error" for hold in held)

    def _story(self, why: str) -> str:
        """Return the reason of a missing connection, with the program's end and last output."""
        if self._program is None:
            return why
        self._program.wait(_STORY)
        return f"{why}; {self.config.command[0]} {self._program.story()}"

    # What was announced.

    def _rig(self) -> Rig | None:
        """Return the cameras whose images are sent, and the IMU of their body, if any."""
        names = self.config.cameras
        cameras = [self._named[name] for name in names if name in self._named]
        if self.camera is None or len(cameras) < len(names):
            return None
        body = self.camera.source.rpartition("/")[0]
        wanted = self.sources.get("imu")
        imus = (imu for imu in self._imus if imu.source == wanted or wanted is None)
        imu = next((imu for imu in imus if wanted or imu.source.rpartition("/")[0] == body), None)
        return Rig(body, tuple(cameras) or (self.camera,), imu)

    def _known(self) -> dict[str, Any]:
        """Return the variables of the templates."""

        def topic(kind: TopicKind, source: str) -> str:
            found = publication(kind, source, self._bridge or PublishingConfig())
            return "" if found is None else found.name

        rig = self._rig()
        vehicles = (each for each in self._vehicles if rig and each.source == rig.body)
        own = {
            "vehicle": next(vehicles, None),
            "topic": topic,
            "folder": str(self._launch.folder),
            "socket": str(self._launch.socket),
        }
        return {
            "cameras": [],
            "imu": None,
            "stereo": False,
            **(variables(rig, topics=self.config.feed == "ros2") if rig else {}),
            **own,
        }


def _source(camera: CameraAnnouncement, kind: str) -> tuple[str, type[Image | DepthImage]]:
    """Return source and type of a camera's images of a kind."""
    both = kind == "grey" and {"rgb", "grey"} <= {*camera.images}
    source = f"{camera.source}/grey" if both else camera.source
    return source, DepthImage if kind == "depth" else Image
