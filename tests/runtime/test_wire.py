"""Events survive being bytes, exactly; bytes that are no event are an error and nothing worse."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from events import Event, Image, PointCloud, PositionSetpoint
from runtime.channels.wire import ALIGNED, Digest, event_type, kind_of, pack, unpack
from runtime.errors import WireError

DTYPES = ["uint8", "int32", ">i4", "float32", "float64", "bool", "complex64"]
arrays = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(
        dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
    )
)


class Measured(Event, eq=False):
    """Holds two arrays of any kind, and whatever else."""

    one: npt.NDArray[Any]
    other: npt.NDArray[Any] | None = None
    extra: Any = None


def digest(event: Event) -> str:
    hasher = Digest()
    hasher(None, event)
    return hasher.hexdigest()


@given(
    st.integers(-(2**63), 2**63 - 1),
    st.text(max_size=20),
    st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
)
def test_small_events_come_back_equal(
    stamp: int, source: str, numbers: tuple[float, float, float]
) -> None:
    event = PositionSetpoint(stamp=stamp, source=source, position=numbers, yaw=numbers[0])
    assert unpack(pack(event).frame()) == event


@pytest.mark.slow
@given(arrays, st.none() | arrays)
def test_arrays_come_back_to_the_byte_and_read_only(
    one: npt.NDArray[Any], other: npt.NDArray[Any] | None
) -> None:
    sent = Measured(stamp=1, source="a", one=one, other=other, extra={"ä": [1, None]})
    back = unpack(pack(sent).frame())
    assert isinstance(back, Measured)
    assert digest(back) == digest(sent)
    assert not back.one.flags.writeable


def test_packing_copies_no_array() -> None:
    image = Image(stamp=0, source="a", frame_id="f", data=np.zeros((4, 5, 3), np.uint8))
    (array,) = pack(image).arrays
    assert np.shares_memory(array, image.data)


def test_arrays_that_are_not_contiguous_are_the_same_elsewhere() -> None:
    data = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)[::2, ::-1]
    back = unpack(pack(Image(stamp=0, source="a", frame_id="f", data=data)).frame())
    assert isinstance(back, Image)
    np.testing.assert_array_equal(back.data, data)


def test_arrays_begin_where_a_processor_likes_them_to() -> None:
    cloud = PointCloud(
        stamp=0,
        source="a",
        points=np.zeros((3, 3), np.float32),
        colors=np.zeros((3, 3), np.uint8),
    )
    packed = pack(cloud)
    assert [offset % ALIGNED for offset in packed.offsets] == [0, 0]
    assert len(packed.frame()) == packed.size


@given(st.binary(max_size=60))
def test_bytes_that_are_no_event_are_an_error(data: bytes) -> None:
    with pytest.raises(WireError):
        unpack(data)


@given(st.data())
def test_damaged_events_are_an_error_or_another_event(data: st.DataObject) -> None:
    event = Measured(stamp=1, source="a", one=np.arange(12.0).reshape(3, 4))
    frame = bytearray(pack(event).frame())
    place = data.draw(st.integers(0, len(frame) - 1))
    frame[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(WireError):
        unpack(frame[: data.draw(st.integers(0, len(frame)))])


def test_what_no_message_can_hold_is_an_error_that_names_it() -> None:
    with pytest.raises(WireError, match=r"Measured cannot be sent elsewhere: .*object"):
        pack(Measured(stamp=0, source="a", one=np.zeros(1), extra=object()))
    with pytest.raises(WireError, match="an array of object"):
        pack(Measured(stamp=0, source="a", one=np.array([None])))


def test_only_known_types_are_made() -> None:
    assert event_type(kind_of(Image)) is Image
    with pytest.raises(WireError, match="'os:system'"):
        event_type("os:system")
