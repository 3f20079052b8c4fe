"""AirSim client node: timing of the requests, events and counts."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, ClassVar, TypeVar

import msgspec

import events as ev
from runtime import Node, Output, Worker, on
from runtime.errors import UncheckableError
from runtime.time.clock import SECOND
from sims.world import Addressee
from visnav_airsim.client import remote
from visnav_airsim.client.connection import Connection, ImageSet, ImageSource, RpcCallError
from visnav_airsim.client.remote import FRAME, AirsimClientConfig, Orders, fetch_remote
from visnav_airsim.wire import CollisionInfo, ImuData, MultirotorState

T = TypeVar("T")
E = TypeVar("E", bound=ev.Event)

# If the server's clock is further off (ns), or behind after a loss, it is another one.
_NEW_CLOCK = 60 * SECOND
_LAST_CALLS = 2.0  # real seconds that a server has for each of the last calls


class AirsimClient(Node[AirsimClientConfig]):
    """A vehicle of a server of AirSim's, Colosseum's or Cosys-AirSim's, in a simulator's place.

    It announces and sends what `Multirotor` does, and obeys the same commands and set-points. On a
    real clock, images, state and commands have connections of their own, and come as they can. In
    lockstep the server is paused and stepped, and the run never goes further than one step ahead.
    """

    flies = True
    deterministic = False
    vehicle: ClassVar[bool] = True

    images = Output(ev.Image)
    depth_images = Output(ev.DepthImage)
    segmentation_images = Output(ev.SegmentationImage)
    camera_poses = Output(ev.PoseStamped)
    transforms = Output(ev.TransformStamped)
    odometry = Output(ev.Odometry)
    imu = Output(ev.Imu)
    vehicle_events = Output(ev.VehicleEvent)

    def __init__(self) -> None:
        config = self.config
        self._lockstep = self.clock.kind == "lockstep"
        self.deterministic = self._lockstep  # type: ignore[misc]  # while the server steps exactly
        self.counts: Counter[str] = Counter()  # how often each thing went wrong
        self._address = config.host, config.port
        self._addressee = Addressee(self.name, self.siblings(AirsimClient), self.sources)
        limit = float(config.call_timeout)
        self._state = Connection(self, self._address, limit)
        self._commands = Connection(self, self._address, limit)
        self._connected = 0  # how often the connections were made
        self._mending = asyncio.Lock()
        self._was_paused = True
        self._shift = 0  # the server's clock less the run's (ns)
        self._newest: dict[str, int] = {}  # stamps by kind of event, or by camera
        self._pose: ev.Odometry | None = None
        self._orders: Orders | None = None

    async def on_startup(self) -> None:
        """Connect, and fetch the server's content and a first set of images."""
        if self.checking:
            raise UncheckableError("which cameras there are is known to the server only")
        try:
            await self._connect()
            await self._fetch_content()
        except BaseException as error:
            self._close()
            if isinstance(error, RpcCallError | ValueError | OSError):
                self.log.fatal("%s:%d: %s", *self._address, error)
            raise

    async def _fetch_content(self) -> None:
        """Fetch everything to announce; a server's first images may take longer."""
        config = self.config
        call = functools.partial(self._state.call, limit=float(config.start_timeout))
        self._remote = server = await fetch_remote(call, config, self.name, self.log.warning)
        for camera in server.first.resampled:
            self.log.warning("%s: its depth has another size than its image: resampled", camera)
        speed, limit = server.clock_speed, float(config.call_timeout)
        if speed != 1.0 and not self._lockstep:
            self.log.warning("expected a ClockSpeed of 1 in real time, found %g", speed)
        arguments = self._address, server.vehicle, server.cosys, server.wanted, limit
        self._source: Worker[ImageSource] = await self.worker(
            ImageSource, *arguments, timeout=2.0 * limit + 10.0
        )

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the vehicle, its IMU and its cameras."""
        return self._remote.announcements

    def check(self) -> Iterable[str]:
        """Return why the server's time cannot be led."""
        peers = (sibling.config for sibling in self.siblings(AirsimClient))
        if self._lockstep and [(p.host, p.port) for p in peers].count(self._address) > 1:
            yield "port: expected one AirsimClient for each server in lockstep, found several"

    async def run(self) -> None:
        """Send the cameras' poses on the body, then the server's data until the end."""
        for camera in self._remote.cameras.values():
            self.transforms.send(
                ev.TransformStamped(
                    stamp=self.clock.now(),
                    source=camera.source,
                    frame_id=FRAME,
                    child_frame_id=camera.frame_id,
                    translation=camera.position,
                    rotation=camera.orientation,
                    static=True,
                )
            )
        if self._lockstep:
            await self._lead()
        await self._relate()  # now that our clock runs, too
        self.start(self._repeat(self.config.image_rate, self._fetch_images))
        self.start(self._repeat(self.config.control_rate, self._obey))
        await self._repeat(self.config.imu_rate, self._read)

    @on(ev.Command)
    def commands(self, event: ev.Command) -> None:
        """Accept a command for this vehicle, or log the reason for its refusal."""
        self._handle_order(event, "commands")

    @on(ev.Setpoint)
    def setpoints(self, event: ev.Setpoint) -> None:
        """Accept a set-point for this vehicle, or log the reason for its refusal."""
        self._handle_order(event, "setpoints")

    def _handle_order(self, order: ev.Command | ev.Setpoint, port: str) -> None:
        if self._orders is None or not self._addressee.obeys(order, port):
            return
        if refusal := self._orders.accept(order):
            self._report(f"{type(order).__name__} refused", refusal)

    async def _lead(self) -> None:
        """Step the server's time; after each step, send the data and pass on orders."""
        rate, period = self.config.imu_rate, round(SECOND / self.config.imu_rate)
        images = max(round(rate / self.config.image_rate), 1)
        control = max(round(rate / self.config.control_rate), 1)
        step = 0

        async def work() -> None:
            if step:
                seconds = period / SECOND / self._remote.clock_speed
                await self._state.call("simContinueForTime", seconds)
            await self._read()
            if step % images == 0:
                await self._fetch_images()
            if step % control == 0:
                await self._obey()

        while True:
            await self.clock.sleep_until(self.clock.now() + period if step else 0)
            await self._guarded(work)
            step += 1

    async def _repeat(self, rate: float, work: Callable[[], Awaitable[None]]) -> None:
        """Repeat `work` at a rate (Hz), or as often as possible."""
        due, period = self.clock.now(), round(SECOND / rate)
        while True:
            await self._guarded(work)
            due = max(due + period, self.clock.now())
            await self.clock.sleep_until(due)

    async def _read(self) -> None:
        vehicle, origin = self._remote.vehicle, self._remote.origin
        state = await self._ask("getMultirotorState", MultirotorState, vehicle)
        sample = await self._ask("getImuData", ImuData, "", vehicle)
        if state is not None:
            await self._follow(state.timestamp - self._shift - self.clock.now())
        if sample is not None:
            before = self._newest.get("imu")
            if event := self._make_event("imu", sample.time_stamp, remote.imu, sample):
                longest = 1.5 * SECOND / self.config.imu_rate
                if before is not None and event.stamp - before > longest:
                    self.counts["gaps between samples of the IMU"] += 1
                self.imu.send(event)
        if state is not None:
            odometry = self._make_event("state", state.timestamp, remote.odometry, state, origin)
            if odometry is not None:
                self._pose = odometry
                self.odometry.send(odometry)

    async def _follow(self, ahead: int) -> None:
        """In lockstep, wait for the server's present instant, `ahead` ns from now."""
        if not -_NEW_CLOCK < ahead < _NEW_CLOCK:
            raise ConnectionResetError(f"the server's clock leaps by {ahead / SECOND:.3g} s")
        if not self._lockstep:
            return
        if ahead and self.deterministic:
            self.deterministic = False  # type: ignore[misc]
            self.log.warning(
                "the server's time is %+.3f ms from where it was to step to: the run follows it, "
                "and is not the same each time",
                ahead / 1e6,
            )
        await self.clock.sleep_until(self.clock.now() + ahead)

    async def _fetch_images(self) -> None:
        images = await self._source.call_for(0.0, ImageSource.fetch)
        if isinstance(images, str):
            self._report("a set of images is lost", images)
        else:
            self._send_images(images)
        contact = await self._ask("simGetCollisionInfo", CollisionInfo, self._remote.vehicle)
        if contact is not None and contact.has_collided and self._pose is not None:
            arguments = contact, self._remote.origin, self._pose
            event = self._make_event("collision", contact.time_stamp, remote.collision, *arguments)
            is_standing = event is not None and event.normal[2] <= -0.7 and event.speed <= 1.0
            if event is not None and not is_standing:
                self.vehicle_events.send(event)

    def _send_images(self, images: ImageSet) -> None:
        outputs: tuple[tuple[str, Any, Any], ...] = (
            ("depth", self.depth_images, ev.DepthImage),
            ("segmentation", self.segmentation_images, ev.SegmentationImage),
            ("rgb", self.images, ev.Image),
        )
        for name, camera in self._remote.cameras.items():
            arguments = images.poses[name], self._remote.origin
            pose = self._make_event(name, images.stamp, remote.camera_pose, *arguments)
            if pose is None:
                continue
            self.camera_poses.send(pose)
            fields: Any = {"source": pose.source, "frame_id": camera.frame_id}
            for kind, output, event in outputs:
                data = images.images.get((name, kind))
                if data is not None and data.shape[:2] == (camera.info.height, camera.info.width):
                    output.send(event(stamp=pose.stamp, **fields, data=data))
                elif data is not None:
                    self._report(pose.source, f"its {kind} images have another size now")

    async def _obey(self) -> None:
        if self._orders is not None and self._pose is not None:
            for event in await self._orders.obey(self.clock.now(), self._pose):
                self.vehicle_events.send(event(stamp=self.clock.now(), source=self.name))

    async def _ask(self, method: str, kind: type[T], *arguments: Any) -> T | None:
        """Call a method and return its converted result; `None` if unusable."""
        try:
            return msgspec.convert(await self._state.call(method, *arguments), kind)
        except (RpcCallError, msgspec.ValidationError) as error:
            self._report(method, str(error))
            return None

    def _make_event(
        self, kind: str, stamp: int, make: Callable[..., E], *arguments: Any
    ) -> E | None:
        """Return an event with the server's stamp; `None` if not new or not valid."""
        stamp -= self._shift
        if stamp <= self._newest.get(kind, -1):
            self.counts[f"{kind}: not newer than the last"] += 1
            return None
        is_body = kind in ("imu", "state", "collision")
        try:
            event = make(stamp, self.name if is_body else f"{self.name}/{kind}", *arguments)
        except (ValueError, TypeError) as error:
            self._report(kind, str(error))
            return None
        self._newest[kind] = stamp
        return event

    def _report(self, fault: str, reason: str) -> None:
        """Count a fault, and log its reason the first time."""
        self.counts[fault] += 1
        if self.counts[fault] == 1:
            self.log.warning("%s: %s", fault, reason)

    async def _guarded(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do `work` with the server; reconnect if a connection is lost meanwhile."""
        before = self._connected
        try:
            await work()
        except OSError as error:
            async with self._mending:
                while before == self._connected:  # nobody else has seen to it
                    if self.config.on_loss == "stop":
                        self.log.fatal("the connection to %s:%d is lost: %s", *self._address, error)
                    self._report("a connection is lost", str(error))
                    await self._connect()
                    with contextlib.suppress(OSError):
                        await self.on_ready()
                        return
                    before = self._connected

    async def _connect(self) -> None:
        seconds = float(self.config.start_timeout)
        try:
            await self._state.connect(seconds)
            await self._commands.connect(seconds)
        except OSError as error:
            self.log.fatal(
                "expected a server of AirSim's at %s:%d within %g s, found none: %s",
                *self._address,
                seconds,
                error,
            )
        self._connected += 1

    async def on_ready(self) -> None:
        """Pause the server in lockstep, relate the clocks, take control of the vehicle."""
        config, call, vehicle = self.config, self._state.call, self._remote.vehicle
        if self._lockstep:
            paused = await call("simIsPaused") is True
            self._was_paused = paused if self._connected == 1 else self._was_paused
            await call("simPause", True)
        state = await self._relate()
        if not config.takeover:
            return
        await self._commands.call("enableApiControl", True, vehicle)
        if self._orders is not None:
            self._orders.resume()
            return
        self._orders = Orders(
            self._commands,
            vehicle,
            state.landed_state == 1,
            round(config.setpoint_timeout * SECOND),
            1.0 / config.control_rate,
            functools.partial(self._report, "refused by the server"),
        )

    async def _relate(self) -> MultirotorState:
        """Relate the server's clock to ours, with no stamp in the future."""
        before = self.clock.now()
        reply = await self._state.call("getMultirotorState", self._remote.vehicle)
        state = msgspec.convert(reply, MultirotorState)
        ahead = state.timestamp - self._shift - self._newest.get("state", 0)
        if not self._newest or not 0 <= ahead < _NEW_CLOCK:
            self._shift = state.timestamp - before
        return state

    async def on_shutdown(self) -> None:
        """Release the vehicle, resume the server's time, and log the counts of faults."""
        for fault, count in sorted(self.counts.items()):
            self.log.info("%s: %d times", fault, count)
        with contextlib.suppress(OSError, RpcCallError):
            if self._orders is not None:
                vehicle, call = self._remote.vehicle, self._commands.call
                await call("cancelLastTask", vehicle, limit=_LAST_CALLS)
                await call("enableApiControl", False, vehicle, limit=_LAST_CALLS)
            if not self._was_paused:
                await self._state.call("simPause", False, limit=_LAST_CALLS)
        self._close()

    def _close(self) -> None:
        self._state.close()
        self._commands.close()
