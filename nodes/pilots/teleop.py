"""Flying by hand: held keys, from any source, become velocities, single keys commands."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated

import msgspec

from events import (
    Arm,
    Command,
    Disarm,
    Hover,
    KeyPressed,
    KeyReleased,
    Land,
    Shutdown,
    Takeoff,
    Vector3,
    VelocitySetpoint,
)
from events.base import KEYS
from nodes.pilots.pilot import Positive, VehicleController, VehicleControllerConfig
from runtime import NodeConfig, Output, Tick, every, on
from runtime.changeable import Changeable
from runtime.errors import suggest

_MOTIONS: dict[str, tuple[int, int, int, int]] = {
    "forward": (1, 0, 0, 0),
    "back": (-1, 0, 0, 0),
    "left": (0, -1, 0, 0),
    "right": (0, 1, 0, 0),
    "up": (0, 0, -1, 0),
    "down": (0, 0, 1, 0),
    "turn_left": (0, 0, 0, -1),
    "turn_right": (0, 0, 0, 1),
}  # signs of x, y, z and yaw rate in the ``heading`` frame: x ahead, y to the right, z down

_COMMANDS: dict[str, type[Command]] = {
    "takeoff": Takeoff, "land": Land, "hover": Hover, "arm": Arm, "disarm": Disarm
}  # fmt: skip

_STILL: Vector3 = (0.0, 0.0, 0.0)


class Keys(NodeConfig):
    """The keys of each action: names as in `KeyPressed`, separated by blanks, ``""`` for none.

    Letters are those of the user's layout: on a French keyboard, say ``forward = "z"`` and so on.
    """

    forward: str = "w"
    back: str = "s"
    left: str = "a"
    right: str = "d"
    up: str = "space r"
    down: str = "left_shift f"
    turn_left: str = "q"
    turn_right: str = "e"
    takeoff: str = "t"
    land: str = "l"
    hover: str = "h"
    arm: str = "m"
    disarm: str = "backspace"  # far from all others: it stops the motors, in the air too
    quit: str = "escape"

    def __post_init__(self) -> None:
        self.actions()

    def actions(self) -> dict[str, str]:
        """Return each key's action; a `ValueError` if a key is unknown, or has two."""
        by_key: dict[str, str] = {}
        for action in self.__struct_fields__:
            for key in getattr(self, action).split():
                if key not in KEYS:
                    raise ValueError(
                        f"expected names of keys, such as w, 7, space or page_up, for {action}; "
                        f"there is no {key!r}{suggest(key, KEYS)}"
                    )
                if key in by_key:
                    raise ValueError(
                        f"expected a key of its own for {action}; {key!r} is for {by_key[key]}"
                    )
                by_key[key] = action
        return by_key


class TeleopConfig(VehicleControllerConfig):
    """Settings of a `Teleop`.

    Attributes:
        vehicle: Name of the vehicle, or free camera, to fly; may be left out if there is only one.
        speed: Horizontal speed, metres per second, on diagonals, too.
        climb_rate: Vertical speed, metres per second.
        yaw_rate: Turning rate, radians per second.
        acceleration: Rate of change of the requested velocity, m/s².
        altitude: Height of a take-off above the ground, metres.
        rate: Set-points per second while keys are held; vehicles ignore those older than half a
            second.
        keys: The keys of each action.
    """

    speed: Changeable[Positive] = 2.0
    climb_rate: Changeable[Positive] = 1.0
    yaw_rate: Changeable[Positive] = 1.0
    acceleration: Changeable[Positive] = 4.0
    altitude: Changeable[Positive] = 1.5
    rate: Annotated[float, msgspec.Meta(ge=4)] = 30.0
    keys: Keys = Keys()


class Teleop(VehicleController[TeleopConfig]):
    """Pilot of a vehicle, or a free camera, by keys.

    While a movement key is held, velocities in the vehicle's heading frame are sent at `rate`;
    after the last one a velocity of zero, and then nothing, so that other nodes' set-points are
    obeyed. A command (take-off, land, hover, …) ends the movement of all held keys. Keys are not
    marked as handled, so others hear them too.
    """

    ends_run = "hand"
    setpoints = Output(VelocitySetpoint)
    shutdowns = Output(Shutdown)

    def __init__(self) -> None:
        super().__init__()
        self._actions = self.config.keys.actions()
        self._held: set[str] = set()  # keys, because two may ask for the same
        self._velocity = _STILL

    def check(self) -> Iterable[str]:
        """Return nothing: a free camera, which is no vehicle, may be flown, too."""
        return ()

    async def on_startup(self) -> None:
        """Log the keys of each action."""
        bindings = msgspec.structs.asdict(self.config.keys)
        self.log.info("keys: %s", ", ".join(f"{a} {k}" for a, k in bindings.items() if k))

    @on(KeyPressed)
    def key_presses(self, event: KeyPressed) -> None:
        """Begin to move, or send a command."""
        action = self._actions.get(event.key)
        if action in _MOTIONS:
            self._held.add(event.key)
        elif action is not None:
            self._held.clear()
            self._velocity = _STILL
            self._send_command(action)

    @on(KeyReleased)
    def key_releases(self, event: KeyReleased) -> None:
        """Stop when the last movement key is released."""
        if event.key in self._held:
            self._held.remove(event.key)
            if not self._held:
                self._stop()

    @every(hz="rate")
    def steer(self, tick: Tick) -> None:
        """Send the velocity commanded by the held keys."""
        if not self._held:
            return
        goal, turn = self._requested()
        seconds = (1 + tick.missed) / self.config.rate
        self._velocity = approach(self._velocity, goal, self.config.acceleration * seconds)
        self._send(self._velocity, turn)

    async def on_shutdown(self) -> None:
        """Stop the vehicle if a movement key is still held."""
        if self._held:
            self._held.clear()
            self._stop()

    def _requested(self) -> tuple[Vector3, float]:
        actions = {self._actions[key] for key in self._held}
        x, y, z, turn = (
            sum(signs) for signs in zip(*map(_MOTIONS.__getitem__, actions), strict=True)
        )
        ahead = self.config.speed / max(math.hypot(x, y), 1.0)
        return (x * ahead, y * ahead, z * self.config.climb_rate), turn * self.config.yaw_rate

    def _stop(self) -> None:
        self._velocity = _STILL
        self._send(_STILL, 0.0)

    def _send(self, velocity: Vector3, yaw_rate: float) -> None:
        self.setpoints.send(
            self.made(VelocitySetpoint, frame_id="heading", velocity=velocity, yaw_rate=yaw_rate)
        )

    def _send_command(self, action: str) -> None:
        if action == "quit":
            stamp, source = self.clock.now(), self.name
            self.shutdowns.send(Shutdown(stamp=stamp, source=source, reason="quit by key"))
            return
        fields = {"altitude": self.config.altitude} if action == "takeoff" else {}
        self.send_command(_COMMANDS[action], **fields)


def approach(now: Vector3, goal: Vector3, step: float) -> Vector3:
    """Return the point `step` from `now` towards `goal`, or `goal` if nearer."""
    distance = math.dist(now, goal)
    if distance <= step:
        return goal
    part = step / distance
    x, y, z = (n + part * (g - n) for n, g in zip(now, goal, strict=True))
    return x, y, z
