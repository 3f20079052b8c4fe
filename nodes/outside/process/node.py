"""External program as a node: started with the run, fed with images, ended with the run."""

from __future__ import annotations

import asyncio
import contextlib
import math
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    Command,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Land,
    PilotAnnouncement,
    PoseEstimate,
    PositionSetpoint,
    SensorAnnouncement,
    Setpoint,
    Takeoff,
    TrackingLost,
    VehicleAnnouncement,
    VelocitySetpoint,
)
from events.camera_info import COEFFICIENTS
from nodes.calibration.formats import variables
from nodes.data.dataset.recording import Rig
from nodes.estimators import Estimator, Mount, TrackingResult
from nodes.outside.native import LinkAnswer, LinkError, LinkOrder, describe
from nodes.outside.process.launch import Launch, ProcessConfig, ProgramError
from nodes.outside.process.program import KINDS, Exposure, Feed, Inputs, Program
from nodes.ros2.messages.mappings import TopicKind, publication
from nodes.ros2.messages.topics import PublishingConfig
from runtime import Node, Output, on
from runtime.channels.bundles import Field, Matcher, Slot
from runtime.channels.hold import Hold, Owed
from runtime.channels.streams import Stream
from runtime.node import CommandLine
from runtime.sensors import sensor_kinds
from runtime.workers.output import Throttle

_BEYOND = 64  # waiting frames beyond the slots, in lockstep with `on_missing = "continue"`
_SLOTS = 256  # unanswered frames without images, at most
_STORY = 0.5  # real seconds to wait for a program's exit code after its connection has closed


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
    lenses = frozenset(COEFFICIENTS)  # the model is in the description

    setpoints = Output(Setpoint, when="pilot")
    commands = Output(Command, when="pilot")

    @classmethod
    def made_from(cls, config: ProcessConfig) -> Iterable[Path | CommandLine]:
        """Return the program, with what builds it."""
        environment = tuple((name, str(value)) for name, value in config.environment.items())
        yield CommandLine(
            words=config.command,
            folder=config.folder,
            environment=environment,
            build=config.build,
        )

    def __init__(self) -> None:
        config = self.config
        self.needs = frozenset(config.images)
        self.scale_free = config.scale_free
        self.method = config.method or (Path(config.command[0]).name if config.command else "")
        self._named: dict[str, CameraAnnouncement] = {}
        self._imus: list[ImuAnnouncement] = []
        self._inputs = Inputs((*dict.fromkeys((*config.reads, *filter(None, [config.asks]))),))
        self._trigger_count = -1
        self._output_mounts: dict[int, Mount] = {}
        self._slots: dict[tuple[str, type], Slot] = {}
        self._feed: Feed | None = None
        self._program: Program | None = None
        self._connected = self._closing = False
        self._pose: npt.NDArray[np.float64] = np.eye(4)
        self._unsent = 0
        self._disconnect_reason = ""
        configs = (node.config for node in self.siblings(Node))
        publishers = (config for config in configs if isinstance(config, PublishingConfig))
        self._bridge = next((config for config in publishers if hasattr(config, "domain_id")), None)
        folder = None if self.out is None else self.out / "programs" / self.name
        self._show = Throttle(lambda line: self.log.info("%s", line))
        self._launch = Launch(config, self._bridge if config.feed == "ros2" else None, folder)

    # Before the run.

    async def on_startup(self) -> None:
        """Create the program's folder, and run the build command."""
        if self.checking:
            return
        await self.offload(self._launch.make_folder, fresh=not self.restarts)
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
            build.request_end()
            show.end()
        if build.code != 0:
            raise ProgramError(f"build: {' '.join(command)} {build.story()}")

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates, if they come from here, and the orders."""
        config = self.config
        if config.feed == "ros2":
            return
        reads = (*sorted(self.needs), *config.reads)
        for announced in super().announce():
            completed = msgspec.structs.replace(announced, reads=reads, vehicle=config.vehicle)
            yield completed
            for name in config.outputs:
                yield msgspec.structs.replace(completed, source=f"{self.name}/{name}")
        if config.pilot:
            yield PilotAnnouncement(stamp=0, source=self.name, vehicle=config.vehicle)

    def on_announcement(self, announcement: Announcement) -> None:
        """Choose the cameras, and record the other sensors."""
        if announcement.source.partition("/")[0] != self.name:
            self._inputs.record(announcement)
        if isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)
        if not self.config.images:
            self.narrow("frames", self.name)  # it has none: it reads no camera
            if isinstance(announcement, VehicleAnnouncement):
                self._vehicles += (announcement,)
            return
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
            self.sources.pop("frames", None)  # images of all these cameras are read

    def check(self) -> Iterable[str]:
        """Yield an error for each missing camera, bridge, program or template."""
        config = self.config
        if config.feed == "ros2" and self._bridge is None:
            yield 'feed: expected a Ros2Bridge in the file for "ros2", found none'
        if config.feed == "link":
            if config.images:
                yield from super().check()
            yield from self._choose_inputs()
            for name in config.cameras:
                images = {*self._named[name].images} if name in self._named else set()
                if missing_kinds := self.needs - images - ({"grey"} if "rgb" in images else set()):
                    kinds = ", ".join(sorted(missing_kinds))
                    yield f"cameras: expected {kinds} images of {name}, found none"
            frames = config.latency * self.camera.rate if self.camera else 2.0
            if config.hold.skips == "allowed" and frames <= 1.0 and self.clock.kind == "lockstep":
                yield (
                    'hold.skips: expected a latency above the camera\'s period with "allowed": no '
                    "later frame goes out while time waits for this one"
                )
        if config.grace > self.shutdown_limit:
            limit = f"{self.shutdown_limit:g} s (run.shutdown_limit)"
            yield f"grace: expected at most {limit}, found {float(config.grace):g} s"
        setting = "build" if self.checking and config.build else "command"  # built later
        if command := getattr(config, setting):
            yield from filter(None, [self._launch.missing(setting, command)])
        yield from filter(None, [self._launch.take_processors(self.share("cpus", list[int]))])
        try:
            self._launch.texts(self._template_variables(), self._rig())
        except ProgramError as error:
            yield str(error)

    async def on_ready(self) -> None:
        """Write the files, start the program, and wait for its connection."""
        config, launch = self.config, self._launch
        self._loop = asyncio.get_running_loop()
        self._end: asyncio.Future[str] = self._loop.create_future()
        rig = self._rig()
        for remark in launch.remarks(rig):
            self.log.warning("calibration: %s", remark)
        for path, text in launch.texts(self._template_variables(), rig).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            await self.offload(path.write_text, text, "utf-8")
        if config.feed == "link":
            self._feed = self._make_feed()
        if config.command:
            start = self.offload(launch.start, config.command, self._show, self._on_end)
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
        imus = [announced.source for _, kind, announced in self._inputs.chosen if kind == "imu"]
        if len(imus) == 1:
            self.narrow("imu", imus[0])
        cameras = rig.cameras if rig else ()
        kinds = [KINDS[kind][0] for kind in config.images]
        self._image_keys = [(number, kind) for number, _ in enumerate(cameras) for kind in kinds]
        if cameras:
            sources = [_source(camera, kind) for camera in cameras for kind in config.images]
            fields = {f"image{n}": Field(event, "one") for n, (_, event) in enumerate(sources)}
            self._matcher = Matcher(Stream(f"{self.name}.frames", 1, "error"), _TOGETHER, fields, 0)
            self._matcher.deliver = self._send
            self._slots = dict(zip(sources, self._matcher.slots.values(), strict=True))
        self._hold: Hold[LinkAnswer] = self.hold(self.name, config.hold, config.latency)
        real = self.clock.kind == "real"
        slots = math.ceil(config.latency * cameras[0].rate) + 2 if cameras else _SLOTS
        continues = config.hold.on_missing == "continue"
        pixels = sum(camera.info.height * camera.info.width for camera in cameras)
        described = [(c, kinds) for c in cameras], self._inputs.chosen, {"kind": self.clock.kind}
        return Feed(
            self._launch.socket,
            describe(*described, config.outputs),
            self._hold,
            self._processes,
            waits=not real,
            room=slots if real else _BEYOND if continues else math.inf,
            slots=slots,
            slot_bytes=pixels * sum(KINDS[kind][1] for kind in config.images),
            gone=self._disconnected,
            logged=self._show.add,
            orders=config.pilot,
        )

    # In the run.

    async def run(self) -> None:
        """Raise `ProgramError` when a program fed by ROS 2 ends."""
        if self.config.feed == "ros2":
            raise ProgramError(await self._end)

    @on(Imu)
    def imu(self, event: Imu) -> None:
        """Store the samples of the IMU until the next frame."""
        self.measurements(event)

    @on(*(k.event for k in sensor_kinds() if k.event is not Imu), PoseEstimate, TrackingLost)
    def measurements(self, event: Event) -> None:
        """Store an input until the next frame; the input `asks` sends a frame itself."""
        name = self._inputs.store(event, self.clock.now())
        if not name or name != self.config.asks or self._feed is None:
            return
        self._trigger_count += 1
        if (
            self._trigger_count % self.config.every == 0
            and self.exposed_at(event) > self._hold.newest
        ):
            self._send_frame(event, self.exposed_at(event), ())

    @on(Image, DepthImage)
    def frames(self, event: Image | DepthImage) -> None:
        """Collect the images of an exposure, which are sent when complete."""
        slot = self._slots.get((event.source, type(event)))
        if slot is not None:
            slot.add(event)

    def _send(self, images: tuple[Image | DepthImage, ...]) -> None:
        """Send an exposure."""
        exposure = [
            (*image_key, image) for image_key, image in zip(self._image_keys, images, strict=True)
        ]
        self._send_frame(images[0], images[0].stamp, exposure)

    def _send_frame(self, event: Event, stamp: int, exposure: Exposure) -> None:
        """Send a frame, with the inputs since the last one, and await the answer."""
        assert self._feed is not None
        owed = self._hold.owe(stamp)
        if not self._hold.expects or self._feed.full:
            self._unsent += 1
            return
        self._feed.send(stamp, exposure, self._inputs.drain())
        self.start(self._deliver(event, owed))

    async def _deliver(self, event: Event, owed: Owed[LinkAnswer]) -> None:
        """Publish the program's answer to a frame."""
        answer = await owed
        if answer is None:
            return
        for message in answer.before:
            if isinstance(message, LinkOrder):
                self._order(message)
            elif message.pose is not None:
                self._publish_further(event, message, message.pose)
        if answer.status == "done":
            return
        lost = answer.pose is None
        self._pose = self._pose if answer.pose is None else answer.pose
        reason = "the program says so" if lost else ""
        fields = answer.points, answer.inliers, answer.velocity, answer.covariance
        self.send_result(event, TrackingResult(self._pose, lost, reason, *fields))

    def _publish_further(
        self, event: Event, answer: LinkAnswer, pose: npt.NDArray[np.float64]
    ) -> None:
        """Publish the pose of another output, in a frame that begins with its first."""
        stamp, number = self.exposed_at(event), answer.output
        mount = self._output_mounts.setdefault(number, self._mounting(stamp))
        result = TrackingResult(pose, velocity=answer.velocity, covariance=answer.covariance)
        source = f"{self.name}/{self.config.outputs[number - 1]}"
        self.estimates.send(mount.estimate(stamp, source, result))

    def _order(self, order: LinkOrder) -> None:
        """Pass an order on to the vehicle."""
        header: Any = {
            "stamp": self.clock.now(),
            "source": self.name,
            "vehicle": self.config.vehicle,
        }
        velocity, yaw_rate = order.velocity, order.yaw_rate
        if order.order == "takeoff":
            self.commands.send(Takeoff(**header, altitude=-order.position[2]))
        elif order.order == "land":
            self.commands.send(Land(**header))
        elif order.order == "position":
            place: Any = {"position": order.position, "velocity": velocity, "yaw": order.yaw}
            self.setpoints.send(PositionSetpoint(**header, **place, yaw_rate=yaw_rate))
        else:
            fields: Any = {"frame_id": order.axes, "velocity": velocity, "yaw_rate": yaw_rate}
            self.setpoints.send(VelocitySetpoint(**header, **fields))

    # After the run.

    async def on_end(self) -> None:
        """Send the program's final trajectory, if it promised one."""
        if self._feed is None or not self._feed.promised:
            return
        self._closing, grace = True, float(self.config.grace)
        try:
            trajectory = await self.offload(self._feed.finish, grace)
        except LinkError as error:
            story = await self.offload(self._story, str(error))
            if self.config.hold.on_missing == "error":
                raise ProgramError(story) from None
            self.log.warning("%s", story)
            return
        offset = self.the_camera().time_offset if self.config.images else 0.0
        stamps = trajectory.stamps - round(offset * 1e9)
        if not self._mounts:
            self._mount(0, int(stamps[0]))
        self.publish_trajectory(stamps, trajectory.poses)

    async def on_shutdown(self) -> None:
        """Close the connection, and end the program if still running."""
        if unsent := self._unsent + (self._feed.left_out if self._feed else 0):
            self.log.warning("%d frames were not sent: the program was gone or had no room", unsent)
        if missed := sum(self._matcher.missed.values()) if self._slots else 0:
            self.log.warning("%d exposures lacked an image", missed)
        if dropped := self._inputs.dropped:
            self.log.warning("%d measurements were dropped: no frame took them along", dropped)
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

    # State of the program, in any thread.

    def _processes(self) -> list[int]:
        return [] if self._program is None else self._program.processes()

    def _disconnected(self, reason: str) -> None:
        """Report the end of the program's connection."""
        self._disconnect_reason = reason
        self._hold.gone(self._story(reason))

    def _on_end(self, story: str) -> None:
        """Report the program's end before the run's."""
        if self._closing:  # as requested
            return
        story = f"{self.config.command[0]} {story}"
        if self._feed is not None:
            self._hold.gone("; ".join(filter(None, [self._disconnect_reason, story])))
            if not self._connected:
                self._feed.close()
        elif self._is_required():
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._end.set_result, story)
        else:
            self.log.warning("%s", story)

    def _is_required(self) -> bool:
        """Return whether the bridge depends on the program's answers."""
        subscriptions = getattr(self._bridge, "subscriptions", ())
        held = [topic.hold for topic in subscriptions if topic.answers_to]
        return not held or any(hold.on_missing == "error" for hold in held)

    def _story(self, reason: str) -> str:
        """Return the reason of a missing connection, with the program's end and last output."""
        if self._program is None:
            return reason
        self._program.wait(_STORY)
        return f"{reason}; {self.config.command[0]} {self._program.story()}"

    # Announced sensors.

    def _choose_inputs(self) -> Iterable[str]:
        """Choose the sensors, and yield an error for each that is missing."""
        rig = self._rig()
        body, imu = (rig.body, rig.imu) if rig else (self.config.vehicle, None)
        yield from self._inputs.choose(body, imu)

    def _sensor(self) -> CameraAnnouncement | SensorAnnouncement:
        """Return the sensor of the pose: the camera, or the body itself."""
        if self.config.images:
            return super()._sensor()
        asks = self.config.asks
        trigger = next(announced for name, _, announced in self._inputs.chosen if name == asks)
        body = trigger.source.rpartition("/")[0] or self.config.vehicle
        body = body or next((vehicle.source for vehicle in self._vehicles), self.name)
        frame = getattr(trigger, "parent_frame_id", "base_link")
        rate = getattr(trigger, "rate", 0.0)
        return SensorAnnouncement(stamp=0, source=f"{body}/", rate=rate, parent_frame_id=frame)

    def _rig(self) -> Rig | None:
        """Return the cameras whose images are sent, and the IMU of their body, if any."""
        names = self.config.cameras
        cameras = [self._named[name] for name in names if name in self._named]
        if self.camera is None or len(cameras) < len(names):
            return None
        body = self.camera.source.rpartition("/")[0]
        imu_name = self.sources.get("imu")
        imus = (imu for imu in self._imus if imu.source == imu_name or imu_name is None)
        imu = next((imu for imu in imus if imu_name or imu.source.rpartition("/")[0] == body), None)
        return Rig(body, tuple(cameras) or (self.camera,), imu)

    def _template_variables(self) -> dict[str, Any]:
        """Return the variables of the templates."""

        def topic(kind: TopicKind, source: str) -> str:
            topic = publication(kind, source, self._bridge or PublishingConfig())
            return "" if topic is None else topic.name

        rig = self._rig()
        vehicles = (vehicle for vehicle in self._vehicles if rig and vehicle.source == rig.body)
        run_variables = {
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
            **run_variables,
        }


def _source(camera: CameraAnnouncement, kind: str) -> tuple[str, type[Image | DepthImage]]:
    """Return source and type of a camera's images of a kind."""
    separate_grey = kind == "grey" and {"rgb", "grey"} <= {*camera.images}
    source = f"{camera.source}/grey" if separate_grey else camera.source
    return source, DepthImage if kind == "depth" else Image
