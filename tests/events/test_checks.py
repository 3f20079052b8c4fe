"""Events that say nonsense cannot be made; whoever tries is told which field is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf, nan
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import events
from events import Category, Event, PoseEstimate, PoseStamped, Quaternion, Vector3
from runtime.channels.wire import pack, unpack

UNCHECKED = Category.WINDOW | Category.INPUT | Category.LIFECYCLE
CHECKED = [
    cls
    for name in events.__all__
    if isinstance(cls := getattr(events, name), type)
    and issubclass(cls, Event)
    and cls is not Event
    and not cls.category & UNCHECKED
]
INFO = events.CameraInfo.from_fov(4, 3, 1.0)
VALID: dict[Any, Any] = {
    int: 1,
    str: "a",
    float: 0.5,
    bool: False,
    Vector3: (1.0, -2.0, 3.0),
    Vector3 | None: (1.0, -2.0, 3.0),
    Quaternion: (0.5, -0.5, 0.5, 0.5),
    tuple[str, ...]: ("rgb",),
    tuple[float, ...]: (),
    tuple[float, float]: (-0.3, 0.3),
    tuple[int, ...]: (3, 4),
    events.CameraInfo: INFO,
}
ARRAYS: dict[str, Any] = {
    "points": np.zeros((2, 3), np.float32),
    "colors": np.zeros((2, 3), np.uint8),
    "inliers": np.zeros(2, np.bool_),
    "intensities": np.zeros(2, np.float32),
    "times": np.zeros(2, np.float32),
    "rings": np.zeros(2, np.uint16),
    "stamps": np.arange(2),
    "positions": np.zeros((2, 3)),
    "orientations": np.tile((1.0, 0.0, 0.0, 0.0), (2, 1)),
}
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=32)


def fields_of(cls: type[Event]) -> dict[str, Any]:
    """Return a valid value for each field of a type of event."""
    values = {
        f.name: VALID[f.type] if f.type in VALID else ARRAYS.get(f.name)
        for f in msgspec.structs.fields(cls)
    }
    if cls is events.TrackedFeatures:
        values["points"] = np.zeros((2, 2), np.float32)
    if "data" in values:
        kind = {"Image": np.uint8, "DepthImage": np.float32, "SegmentationImage": np.int32}
        values["data"] = np.zeros((3, 4), kind[cls.__name__])
    return values


def wrong_values(type_: Any, name: str) -> Iterator[Any]:
    if name == "stamp":
        yield from (1.0, True, np.int64(1), np.float64(1), None, "1", nan)
    if type_ in {Vector3, Vector3 | None, Quaternion}:
        size = 4 if type_ == Quaternion else 3
        for number in (nan, inf, -inf, None, "1"):
            yield (number, *(0.5,) * (size - 1))
            yield (*(0.5,) * (size - 1), number)
        yield from ((0.5,) * (size + 1), (0.5,) * (size - 1), [0.5] * size, np.full(size, 0.5), nan)
    if type_ == Quaternion:
        yield from ((0.0,) * 4, (0.0, 0.0, 0.0, 1.002), (0.998, 0.0, 0.0, 0.0), (1.0,) * 4)


@pytest.mark.slow
def test_no_field_of_any_event_may_be_wrong() -> None:
    for cls in CHECKED:
        right = fields_of(cls)
        cls(**right)
        wrong = [
            (field.name, value)
            for field in msgspec.structs.fields(cls)
            for value in wrong_values(field.type, field.name)
        ]
        for name, value in wrong:
            with pytest.raises((TypeError, ValueError), match=rf"^{cls.__name__}\.{name}: "):
                cls(**right | {name: value})
        assert len(wrong) > 5, cls


@pytest.mark.parametrize(
    ("cls", "field"),
    [
        (events.PositionSetpoint, "yaw"),
        (events.PositionSetpoint, "yaw_rate"),
        (events.VelocitySetpoint, "yaw_rate"),
        (events.AttitudeSetpoint, "thrust"),
        (events.BodyRateSetpoint, "thrust"),
        (events.MotorSetpoint, "motor1"),
        (events.MotorSetpoint, "motor4"),
        (events.PlannedPose, "yaw"),
        (events.Takeoff, "altitude"),
        (events.NavSatFix, "latitude"),
        (events.FluidPressure, "fluid_pressure"),
        (events.CameraAnnouncement, "rate"),
        (events.VehicleAnnouncement, "mass"),
    ],
)
def test_what_steers_or_is_measured_is_finite(cls: type[Event], field: str) -> None:
    for wrong in (nan, inf):
        with pytest.raises(ValueError, match=rf"^{cls.__name__}\.{field}: expected finite"):
            cls(**fields_of(cls) | {field: wrong})


def test_the_message_says_what_was_found() -> None:
    with pytest.raises(ValueError, match=r"found \(0\.5, 0, 0, 0\) \(tuple\), whose norm is 0\.5"):
        PoseStamped(stamp=0, source="a", position=(0, 0, 0), orientation=(0.5, 0, 0, 0))


@given(st.tuples(FINITE, FINITE, FINITE), st.tuples(FINITE, FINITE, FINITE, FINITE))
def test_a_pose_is_made_exactly_if_it_is_one(position: Vector3, orientation: Quaternion) -> None:
    norm = sum(n * n for n in orientation) ** 0.5
    scaled = tuple(n / norm for n in orientation) if norm > 1e-6 else (1.0, 0.0, 0.0, 0.0)
    for quaternion in (orientation, scaled):
        right = abs(sum(n * n for n in quaternion) ** 0.5 - 1.0) <= 1e-3
        try:
            made = PoseEstimate(stamp=0, source="a", position=position, orientation=quaternion)
        except ValueError:
            assert not right
        else:
            assert right
            assert unpack(pack(made).frame()) == made


def test_a_range_without_an_end_and_numbers_of_numpy_are_right() -> None:
    event = events.Range(stamp=0, source="a", range=inf, min_range=0.1, max_range=9.0)
    assert event.range == inf
    position = tuple(np.array([1.0, 2.0, 3.0]))
    turn = tuple(np.array([1.0, 0.0, 0.0, 0.0], np.float32))
    assert PoseStamped(stamp=0, source="a", position=position, orientation=turn).position[1] == 2.0
    huge = (1e308, 1e308, 1e308)  # whose norm is not finite, but they are
    PoseStamped(stamp=0, source="a", position=huge, orientation=(1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("wrong", [(0.0,) * 35, (0.0,) * 37, [0.0] * 36, None, np.zeros(36), (1,)])
def test_a_covariance_of_another_shape_is_refused(wrong: Any) -> None:
    values = fields_of(PoseEstimate)
    with pytest.raises(TypeError, match=r"PoseEstimate.covariance: expected a tuple of 36 numbers"):
        PoseEstimate(**values | {"covariance": wrong})


@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_a_covariance_that_is_not_finite_is_refused(number: float) -> None:
    values = fields_of(PoseEstimate)
    with pytest.raises(ValueError, match=r"covariance: expected finite numbers"):
        PoseEstimate(**values | {"covariance": (0.0,) * 35 + (number,)})
    assert PoseEstimate(**values | {"covariance": (0.0,) * 36}).covariance == (0.0,) * 36
