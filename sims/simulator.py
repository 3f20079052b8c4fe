"""Common base of simulator nodes: a world, its cameras, and routing of orders."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any

import msgspec
from typing_extensions import TypeVar

import events as ev
from events.frames import rotate_inverse
from runtime import Duration, Node, NodeConfig, Output
from runtime.errors import suggest
from runtime.host import Sibling
from runtime.paths import NameOrPath
from sims.cameras import CameraSpec
from sims.cameras.rig import CameraOutputs, CameraRig
from sims.cameras.stage import RendererName
from sims.vehicle import State
from sims.world import Inhabitant

Latitude = Annotated[float, msgspec.Meta(ge=-90, le=90)]
Longitude = Annotated[float, msgspec.Meta(ge=-180, le=180)]
Count = Annotated[int, msgspec.Meta(ge=1, le=16)]


class SimulatorConfig(NodeConfig):
    """Settings of every simulator.

    Attributes:
        world: Built-in world (``hall``, ``yard``, ``corridor``, ``office``, ``night``, ``forest``)
            or path of an MJCF file; empty for the other vehicles', or ``hall``. In MJCF x is north,
            y west, z up; in all settings and events x is north, y east, z down (NED): ``pos="1 2
            3"`` is (1, -2, -3) in ``map``.
        origin: Where the origin of ``map`` is on the earth: latitude and longitude, degrees north
            and east, and altitude, metres above the WGS 84 ellipsoid, which here is sea level too.
        cameras: The cameras that are carried.
        camera_processes: Number of processes that render.
        render_threads: Threads that draw in each of them; images do not depend on it.
        renderer: ``mujoco``: MuJoCo's, by OpenGL; its pixels depend on the driver. ``raster``: the
            project's own, about twice as quick, with the same bytes on every machine.
        setpoint_timeout: Age beyond which set-points are ignored, but of position or pose.
    """

    world: NameOrPath = ""
    origin: tuple[Latitude, Longitude, float] = (47.641468, -122.140165, 122.0)
    cameras: tuple[CameraSpec, ...] = ()
    camera_processes: Count = 2
    render_threads: Count = 1
    renderer: RendererName = "raster"
    setpoint_timeout: Duration = Duration(0.5)  # immutable


C = TypeVar("C", bound=SimulatorConfig, default=SimulatorConfig)


class Simulator(Inhabitant, Node[C], ABC):
    """Base of the simulators' nodes: their common outputs, and the cameras.

    A subclass's `on_startup` calls this one's, compiles the model and starts the rig.
    """

    flies = True

    images = Output(ev.Image)
    depth_images = Output(ev.DepthImage)
    segmentation_images = Output(ev.SegmentationImage)
    camera_poses = Output(ev.PoseStamped)
    transforms = Output(ev.TransformStamped)
    odometry = Output(ev.Odometry)

    @property
    @abstractmethod
    def frame_id(self) -> str:
        """Frame of the cameras' body."""

    @property
    def cameras(self) -> tuple[CameraSpec, ...]:
        """The cameras as they are used."""
        return self.config.cameras

    async def on_startup(self) -> None:
        """Prepare the cameras and the routing of orders."""
        config = self.config
        self._addressee = Addressee(self.name, self.siblings(Simulator), self.sources)
        outputs = CameraOutputs(
            self.images, self.depth_images, self.segmentation_images, self.camera_poses
        )
        self.rig = CameraRig(
            self,
            self.cameras,
            outputs,
            config.camera_processes,
            config.render_threads,
            config.renderer,
        )

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the cameras."""
        return self.rig.announcements(self.frame_id)

    def _send_state(self, stamp: int, state: State) -> None:
        self.odometry.send(
            ev.Odometry(
                stamp=stamp,
                source=self.name,
                child_frame_id=self.frame_id,
                position=state.position,
                orientation=state.orientation,
                linear_velocity=rotate_inverse(state.orientation, state.velocity),
                angular_velocity=state.angular_velocity,
            )
        )

    def on_change(self, before: Any) -> None:  # noqa: ARG002
        """Deliver images as the changed settings say."""
        self.rig.change(self.cameras)

    async def run(self) -> None:
        """Send the poses of the cameras on the body, once."""
        for mounting in self.rig.transforms(self.frame_id):
            self.transforms.send(mounting)

    async def on_shutdown(self) -> None:
        """Log how many images are missing."""
        self.rig.log_missing()


Order = ev.Command | ev.Setpoint | ev.PathAnnouncement | ev.PilotAnnouncement


class Addressee:
    """Routing of orders to vehicles, or to free cameras if there are none.

    An order that names a vehicle is for that one. One that names none is for the only vehicle of
    the run, and for those whose ports are narrowed to its source.
    """

    def __init__(self, name: str, simulators: Sequence[Sibling], ports: Mapping[str, str]) -> None:
        self._name = name
        self._ports = ports
        self._simulators = simulators
        self._known = [each.name for each in simulators]
        vehicles = [each.name for each in simulators if each.node.vehicle]
        self._vehicles = vehicles or self._known
        self._refused: set[tuple[str, str]] = set()

    def obeys(self, order: Order, port: str) -> bool:
        """Return whether an order at a port, or a pilot's path, is for this vehicle."""
        narrowed = self._ports.get(port)
        if narrowed and not f"{order.source}/".startswith(f"{narrowed}/"):
            return False
        if order.vehicle:
            return order.vehicle == self._name
        return bool(narrowed) or self._vehicles == [self._name]

    def refusal(self, order: Order) -> str:
        """Return, only of the first vehicle, the reason against an order for nobody, once."""
        key = (order.source, order.vehicle)
        if self._vehicles[0] != self._name or key in self._refused:
            return ""
        reason = "" if not order.vehicle and self._narrowed_to(order.source) else self._fault(order)
        if reason:
            self._refused.add(key)
        return reason

    def complaints(self, pilots: Iterable[ev.PilotAnnouncement]) -> Iterator[str]:
        """Yield errors in the vehicles named by pilots, if this is the first vehicle."""
        for pilot in pilots:
            if reason := self.refusal(pilot):
                yield f"{pilot.source}: vehicle: {reason}"

    def _fault(self, order: Order) -> str:
        if order.vehicle in self._known or (not order.vehicle and len(self._vehicles) < 2):
            return ""
        found = (
            f'"{order.vehicle}"{suggest(order.vehicle, self._known)}' if order.vehicle else "none"
        )
        return f"expected one of {', '.join(self._vehicles)}, found {found}"

    def _narrowed_to(self, source: str) -> bool:
        return any(
            f"{source}/".startswith(f"{narrowed}/")
            for each in self._simulators
            for port, narrowed in each.sources.items()
            if port in ("commands", "setpoints")
        )
