"""Dynamics of a world in simulated time: bodies, lights, fog and wind.

Physics, renderers and lidars, each in its own process, apply the same `Dynamics` to their copy of
the model, and so see the same world at the same time.

Wind in SI units, NED: MIL-F-8785C, "Flying Qualities of Piloted Airplanes" (1980), section 3.7, low
altitude.
"""

from __future__ import annotations

import math
import zlib
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import msgspec
import mujoco
import numpy as np

from events import Vector3
from events.frames import flip_yz
from runtime.errors import suggest
from runtime.portable import Floats, directions, gaussian
from runtime.units import Duration


class Motion(msgspec.Struct, frozen=True):
    """Motion or change in a world; can be pickled."""

    solid: ClassVar[bool] = False  # whether vehicles can touch the moved part

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Write the part's state at a time into model and data, whatever was there before.

        It may write lights and colours of `model`, ``mocap_pos`` and ``mocap_quat`` of `data`.
        """


class Dynamics(NamedTuple):
    """All self-moving and changing parts of a world."""

    motions: tuple[Motion, ...] = ()
    fog: bool = False  # whether the world is drawn with fog, as MuJoCo's settings of it say

    def joined(self, other: Dynamics) -> Dynamics:
        """Return these dynamics combined with others."""
        return Dynamics(self.motions + other.motions, self.fog or other.fog)

    @property
    def solid(self) -> Dynamics:
        """Dynamics of the parts vehicles can touch."""
        return Dynamics(tuple(motion for motion in self.motions if motion.solid))

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Set the world to a time; kinematics and lights are computed afterwards."""
        for motion in self.motions:
            motion.apply(model, data, seconds)


class Scene(NamedTuple):
    """World before compilation, with its dynamics."""

    spec: mujoco.MjSpec
    dynamics: Dynamics = Dynamics()


_YAW_STEP = 0.02  # interval of the precomputed headings, seconds
_TURN = 0.25  # standard deviation of the smoothing of headings, seconds


def within(seconds: float, times: Sequence[float], loop: bool) -> float:
    """Return a time within a curve's: the end holds, or the beginning comes again."""
    first, last = times[0], times[-1]
    if loop and last > first and seconds > first:
        return first + (seconds - first) % (last - first)
    return min(max(seconds, first), last)


def interpolated(
    times: Sequence[float], values: Sequence[float], seconds: float, *, loop: bool, smooth: bool
) -> float:
    """Return a curve's value at a time, between its knots linear or with rest at each of them."""
    seconds = within(seconds, times, loop)
    after = min(bisect_right(times, seconds), len(times) - 1)
    if after == 0:
        return values[0]
    before = after - 1
    share = (seconds - times[before]) / (times[after] - times[before])
    if smooth:
        share *= share * (3.0 - 2.0 * share)
    return values[before] + share * (values[after] - values[before])


class Path(NamedTuple):
    """A smooth way through places, with the heading of its direction."""

    times: tuple[float, ...]  # when it is at each place, seconds, rising
    # For each stretch the coefficients of (t - its start)³, ², ¹ and ⁰, each (x, y, z).
    cubics: tuple[Any, ...]
    yaws: tuple[float, ...]  # headings, radians, at equal steps from the first time to the last
    loop: bool  # whether it begins anew when it is over; else its end holds

    def at(self, seconds: float) -> tuple[Vector3, float]:
        """Return the place and the heading (radians) at a time."""
        seconds = within(seconds, self.times, self.loop)
        stretch = min(bisect_right(self.times, seconds), len(self.times) - 1) - 1
        t = seconds - self.times[stretch]
        a, b, c, d = self.cubics[stretch]
        x, y, z = (((p * t + q) * t + r) * t + s for p, q, r, s in zip(a, b, c, d, strict=True))
        step, rest = divmod((seconds - self.times[0]) / _YAW_STEP, 1.0)
        here = min(int(step), len(self.yaws) - 2)
        yaw = self.yaws[here] + rest * (self.yaws[here + 1] - self.yaws[here])
        return (x, y, z), yaw


def path_through(
    places: Sequence[Vector3], times: Sequence[float], *, loop: bool, yaw: float
) -> Path:
    """Return a cubic spline through places, at rest at its ends, or periodic.

    Args:
        places: At least two; of a loop the last one is the first.
        times: When it is to be at each, seconds, rising.
        yaw: Heading until it first moves, radians.
    """
    from scipy.interpolate import CubicSpline  # a tenth of a second, which only moving bodies need

    spline = CubicSpline(times, places, bc_type="periodic" if loop else "clamped")
    spline.c[:] = np.round(spline.c, 10)  # the last bits of what was solved are the processor's
    at = np.arange(times[0], times[-1] + 2 * _YAW_STEP, _YAW_STEP)
    velocity = spline(np.minimum(at, times[-1]), 1)
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > 0.02
    last = np.maximum.accumulate(np.where(moving, np.arange(len(at)), -1))
    if loop and moving.any():  # what stands at the beginning has come from the end
        last = np.where(last < 0, int(np.flatnonzero(moving)[-1]), last)
    heading = directions(velocity)
    yaws = np.unwrap(np.where(last >= 0, heading[last], yaw))
    cubics: Any = spline.c.transpose(1, 0, 2).tolist()
    return Path(
        tuple(float(t) for t in times),
        tuple(tuple(tuple(row) for row in stretch) for stretch in cubics),
        tuple(_smoothed(yaws, loop).tolist()),
        loop,
    )


def _smoothed(yaws: Floats, loop: bool) -> Floats:
    """Smooth headings with a Gaussian window; loops continue, with their turns."""
    width = _TURN / _YAW_STEP
    reach = min(math.ceil(3 * width), len(yaws) - 1)
    if loop:
        turns = yaws[-1] - yaws[0]
        turns = round(turns / math.tau) * math.tau
        before, after = yaws[-reach - 1 : -1] - turns, yaws[1 : reach + 1] + turns
        padded = np.unwrap(np.concatenate([before, yaws, after]))
    else:
        padded = np.pad(yaws, reach, mode="edge")
    return gaussian(padded, width, reach)


NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]

HEADLIGHT = "headlight"  # MuJoCo's name for the light from everywhere, present in all worlds


class Changing(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How something changes in time.

    Attributes:
        times: When `factors` hold; in between they change evenly.
        factors: Strengths at these times, of what it is in the world.
        loop: Whether it begins anew after the last time; else the last factor holds.
    """

    times: tuple[Duration, ...] = (Duration(0),)
    factors: tuple[NonNegative, ...] = (1.0,)
    loop: bool = False

    def __post_init__(self) -> None:
        if not self.times or len(self.times) != len(self.factors):
            raise ValueError(
                f"times, factors: expected as many of each, and one at least, found "
                f"{len(self.times)} and {len(self.factors)}"
            )
        if any(after <= before for before, after in pairwise(self.times)):
            raise ValueError(f"times: expected rising ones, found {list(self.times)}")

    def factor(self, seconds: float) -> float:
        """Return the strength at a time."""
        return interpolated(self.times, self.factors, seconds, loop=self.loop, smooth=False)


class LightSpec(Changing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a time-varying light of the world.

    Attributes:
        name: The light's name; ``headlight`` for the light from everywhere; ``*`` for all.
        flicker: Share of its strength lost in flicker, at random but always alike.
        flicker_rate: Rate of the flicker, Hz.
        directions: Rays' directions at the `times`, north, east, down; empty for the world's own.
    """

    name: str = "*"
    flicker: Share = 0.0
    flicker_rate: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    directions: tuple[Vector3, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.directions and len(self.directions) != len(self.times):
            raise ValueError(
                f"directions: expected one for each of {len(self.times)} times, "
                f"found {len(self.directions)}"
            )

    def strength(self, seconds: float) -> float:
        """Return its strength at a time, flicker included."""
        step, rest = divmod(seconds * self.flicker_rate, 1.0)
        here, next_ = (zlib.crc32(b"%d" % (step + i)) / 0xFFFFFFFF for i in (0, 1))
        return self.factor(seconds) * (1.0 - self.flicker * (here + rest * (next_ - here)))


class FogSpec(Changing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the fog.

    Attributes:
        start: Distance at which it begins, metres.
        end: Distance beyond which there is nothing but fog, metres. A factor of 2 halves both.
        colour: Red, green and blue, 0 to 1.
    """

    start: NonNegative = 0.0
    end: Annotated[float, msgspec.Meta(gt=0)] = 30.0
    colour: tuple[Share, Share, Share] = (0.72, 0.75, 0.78)


class LightMotion(Motion, frozen=True):
    """A light's strength and direction at each time."""

    name: str
    spec: LightSpec
    colours: tuple[tuple[float, ...], ...]

    def apply(self, model: Any, data: Any, seconds: float) -> None:  # noqa: ARG002
        """Set the light's strength and direction at a time."""
        strength = self.spec.strength(seconds)
        colours = [[strength * channel for channel in colour] for colour in self.colours]
        if self.name == HEADLIGHT:
            light = model.vis.headlight
            light.ambient[:], light.diffuse[:], light.specular[:] = colours
            return
        light = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_LIGHT, self.name)
        model.light_ambient[light], model.light_diffuse[light] = colours[:2]
        model.light_specular[light] = colours[2]
        if self.spec.directions:
            x, y, z = (
                interpolated(self.spec.times, axis, seconds, loop=self.spec.loop, smooth=False)
                for axis in zip(*self.spec.directions, strict=True)
            )
            length = (x * x + y * y + z * z) ** 0.5 or 1.0
            model.light_dir[light] = flip_yz((x / length, y / length, z / length))


class FogMotion(Motion, frozen=True):
    """How thick the fog is at each time."""

    spec: FogSpec

    def apply(self, model: Any, data: Any, seconds: float) -> None:  # noqa: ARG002
        """Set the fog's thickness at a time."""
        factor = max(self.spec.factor(seconds), 1e-3)
        fog = model.vis.map
        fog.fogstart = self.spec.start / factor / model.stat.extent
        fog.fogend = self.spec.end / factor / model.stat.extent


def change_lights(scene: Scene, specs: tuple[LightSpec, ...]) -> Dynamics:
    """Return how lights change; `ValueError` if unknown, or of a direction for all or headlight."""
    world: Any = scene.spec
    lights = {light.name: light for light in world.lights if light.name}
    lights[HEADLIGHT] = world.visual.headlight
    motions = []
    for spec in specs:
        if spec.name != "*" and spec.name not in lights:
            raise ValueError(
                f"lights: expected one of {', '.join(lights)} or *, found "
                f'"{spec.name}"{suggest(spec.name, lights)}'
            )
        names = list(lights) if spec.name == "*" else [spec.name]
        if spec.directions and (spec.name == "*" or spec.name == HEADLIGHT):
            raise ValueError(f"lights: directions: expected those of one light, found {spec.name}")
        for name in names:
            light = lights[name]
            colours = tuple(
                tuple(float(channel) for channel in colour)
                for colour in (light.ambient, light.diffuse, light.specular)
            )
            motions.append(LightMotion(name, spec, colours))
    return Dynamics(tuple(motions))


def add_fog(scene: Scene, spec: FogSpec) -> Dynamics:
    """Add fog to a world, and return its dynamics."""
    scene.spec.visual.rgba.fog = [*spec.colour, 1.0]
    return Dynamics((FogMotion(spec),), fog=True)


FOOT = 0.3048
KNOT = 0.514444
W20 = {"none": 0.0, "light": 15 * KNOT, "moderate": 30 * KNOT, "severe": 45 * KNOT}
"""Wind at a height of 20 feet by strength of turbulence, m/s."""

STRONGEST = 50.0
"""Limit of mean wind and gusts together, m/s: in 1 ms, more carries a vehicle past a wall."""

LOWEST, HIGHEST = 10 * FOOT, 1000 * FOOT
"""Range of heights of the model, metres; other heights are clipped."""

SLOWEST = 1.0  # least airspeed assumed for turbulence, m/s; at 0 the turbulence would stand still


def check_strength(*velocities: Vector3) -> None:
    """Refuse velocities (m/s) beyond `STRONGEST` together, with a `ValueError`."""
    total = sum(math.hypot(*velocity) for velocity in velocities)
    if not total <= STRONGEST:
        raise ValueError(
            f"velocity: expected up to {STRONGEST:g} m/s, gusts included, since the wind could "
            f"carry a vehicle through walls otherwise, found {total:g} m/s"
        )


class Gust(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Discrete gust of the shape 1 - cos, in addition to the mean wind.

    Attributes:
        velocity: Peak velocity, m/s north, east, down.
        start: Time of its beginning.
        rise: Time of its rise, and of its fall.
        hold: Time at its peak in between.
        period: Time from its beginning to the next; 0 for a single gust.
    """

    velocity: Vector3
    start: Duration = Duration(0)  # immutable
    rise: Duration = Duration(1.0)
    hold: Duration = Duration(0)
    period: Duration = Duration(0)

    def __post_init__(self) -> None:
        if not self.rise:
            raise ValueError("rise: expected a time above 0, found 0")
        if 0 < self.period < 2 * self.rise + self.hold:
            raise ValueError(
                f"period: expected at least the {2 * self.rise + self.hold:g} s that the gust "
                f"takes, found {self.period:g} s"
            )

    def share(self, seconds: float) -> float:
        """Return the gust's strength at a time, 0 to 1."""
        since = seconds - self.start
        if since <= 0.0:
            return 0.0
        if self.period:
            since %= self.period
        rise = min(since, 2 * self.rise + self.hold - since) / self.rise
        return 0.5 * (1.0 - math.cos(math.pi * min(max(rise, 0.0), 1.0)))


class WindSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the wind.

    Attributes:
        velocity: Mean velocity of the air, m/s north, east, down: [5, 0, 0] blows to the north.
        gusts: Discrete gusts.
        turbulence: Strength of Dryden's turbulence (MIL-F-8785C, low altitude): ``none``,
            ``light``, ``moderate``, ``severe``, or the wind at 20 feet, m/s. Its scale depends on a
            vehicle's height above the world's zero and airspeed.
    """

    velocity: Vector3 = (0.0, 0.0, 0.0)
    gusts: tuple[Gust, ...] = ()
    turbulence: (
        Literal["none", "light", "moderate", "severe"]
        | Annotated[float, msgspec.Meta(ge=0, le=STRONGEST)]
    ) = "none"

    def __post_init__(self) -> None:
        check_strength(self.velocity, *(gust.velocity for gust in self.gusts))

    @property
    def w20(self) -> float:
        """Wind at a height of 20 feet for the turbulence, m/s."""
        return W20[self.turbulence] if isinstance(self.turbulence, str) else self.turbulence

    @property
    def still(self) -> bool:
        """Whether there is no wind at all."""
        return not (any(self.velocity) or self.gusts or self.w20)


def scales(height: float, w20: float) -> tuple[Vector3, Vector3]:
    """Return intensities (m/s) and lengths (m) along, across, vertical, by height and wind."""
    height = min(max(height, LOWEST), HIGHEST)
    shape = 0.177 + 0.000823 * height / FOOT
    vertical = 0.1 * w20
    flat = vertical / shape**0.4
    length = height / shape**1.2
    return (flat, flat, vertical), (length, length, height)


class Turbulence:
    """Exactly discretised Dryden filters of white noise, for a place in the air.

    Their states have no unit and are scaled by each height's intensity, so a change of height or
    speed changes only the velocity's scale suddenly.

    Args:
        start: Five numbers, normally distributed, from which the states are drawn.
    """

    NUMBERS = 5  # random numbers per step

    def __init__(self, start: list[float]) -> None:
        u, v1, v2, w1, w2 = start
        # Stationary: variances 1/2 and 1/4 of the two states, covariance 1/4.
        half, quarter = math.sqrt(0.5), math.sqrt(0.125)
        self._u = u
        self._v = (half * v1, quarter * (v1 + v2))
        self._w = (half * w1, quarter * (w1 + w2))

    def step(
        self, seconds: float, speed: float, height: float, w20: float, noise: list[float]
    ) -> Vector3:
        """Return the velocity along, across, vertical (m/s) after some seconds more.

        Args:
            speed: Through the air, metres per second.
            height: Metres above the ground.
            w20: Wind at a height of 20 feet, m/s.
            noise: Five normal numbers.
        """
        sigma, length = scales(height, w20)
        way = max(speed, SLOWEST) * seconds
        keep = math.exp(-way / length[0])
        self._u = keep * self._u + math.sqrt(1.0 - keep * keep) * noise[0]
        self._v = _second_order(self._v, way / length[1], noise[1], noise[2])
        self._w = _second_order(self._w, way / length[2], noise[3], noise[4])
        return sigma[0] * self._u, sigma[1] * _output(self._v), sigma[2] * _output(self._w)


def _second_order(
    state: tuple[float, float], d: float, first: float, second: float
) -> tuple[float, float]:
    """Step x1' = -x1 + n, x2' = -x2 + x1 by d, with white noise n of intensity 1."""
    x1, x2 = state
    keep, gone = math.exp(-d), math.exp(-2.0 * d)
    q11 = 0.5 * (1.0 - gone)
    q12 = 0.25 * (1.0 - gone * (1.0 + 2.0 * d))
    q22 = 0.25 * (1.0 - gone * (1.0 + 2.0 * d + 2.0 * d * d))
    l11 = math.sqrt(q11)
    l21 = q12 / l11
    l22 = math.sqrt(max(q22 - l21 * l21, 0.0))
    return keep * x1 + l11 * first, keep * (d * x1 + x2) + l21 * first + l22 * second


def _output(state: tuple[float, float]) -> float:
    """Return (1 + √3 s) / (1 + s)² of the noise: of variance 1."""
    root = math.sqrt(3.0)
    return root * state[0] + (1.0 - root) * state[1]


def turned(velocity: Vector3, mean: Vector3) -> Vector3:
    """Return a velocity along, across and vertical in ``map``; along north if there is no mean."""
    along, across, down = velocity
    flat = math.hypot(mean[0], mean[1])
    c, s = (mean[0] / flat, mean[1] / flat) if flat > 1e-9 else (1.0, 0.0)
    return c * along - s * across, s * along + c * across, down
