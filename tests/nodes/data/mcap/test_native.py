"""An event's own message: CDR that ROS reads, with the arrays in it or elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from events import Event
from nodes.data.mcap import native
from nodes.ros2.messages.typestore import TypeStore
from runtime.channels.wire import kind_of, pack
from runtime.errors import WireError
from tests.nodes.data.recorder.samples import announcements, cloud, depth, image, imu, said, same

ALL = [*announcements(), *said(5)]


@pytest.mark.parametrize("event", ALL, ids=lambda e: f"{type(e).__name__} {e.source}")
def test_a_message_gives_back_its_event(event: Event) -> None:
    """Also what it says of itself: kind and source, and that nothing is lacking."""
    frame = pack(event).frame()
    message = native.message(frame)
    assert same(native.event(message), event)
    assert native.missing_arrays(message) == []
    assert native.describe(frame) == (kind_of(type(event)), event.source)
    assert native.fields(message)["stamp"] == 5 or event.stamp == 0


@pytest.mark.parametrize("event", [image(1), depth(1), cloud(1, "map", 4, colours=True)])
def test_a_message_without_its_arrays_takes_them_from_elsewhere(event: Event) -> None:
    """It is small, tells which arrays it lacks, and is whole again with them."""
    packed = pack(event)
    message = native.message(packed.frame(), arrays=False)
    assert len(message) < 300
    assert [array.shape for array in native.missing_arrays(message)] == [
        a.shape for a in packed.arrays
    ]
    assert same(native.event(message, packed.arrays), event)


def test_arrays_of_nothing_are_lacking_or_not() -> None:
    """A cloud of no points is the same event either way."""
    empty = cloud(1, "map", 0, colours=True)
    for arrays in (True, False):
        message = native.message(pack(empty).frame(), arrays)
        missing = [np.zeros(array.shape, array.dtype) for array in native.missing_arrays(message)]
        assert same(native.event(message, missing), empty)


def test_the_message_is_what_rosbags_would_make() -> None:
    """Its bytes are those of a UInt8MultiArray with the frame as data."""
    store = TypeStore()
    frame = pack(imu(7)).frame()
    layout = store.message("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0)
    data = np.frombuffer(frame, np.uint8)
    made = store.serialize(store.message(native.TYPE)(layout=layout, data=data))
    assert bytes(made) == native.message(frame)


def test_other_arrays_than_those_that_lack_are_refused() -> None:
    """Shape and type must be those that were recorded."""
    message = native.message(pack(image(1)).frame(), arrays=False)
    with pytest.raises(WireError, match="expected arrays of"):
        native.event(message, [np.zeros((5, 4, 3), np.uint8)])


@pytest.mark.parametrize("data", [b"", b"\0" * 20, b"\0" * 16 + b"\xff\xff\xff\xff", b"x" * 64])
def test_nonsense_is_refused(data: bytes) -> None:
    """With an error that says so, whatever is asked of it."""
    for ask in (native.missing_arrays, native.event, native.fields):
        with pytest.raises(WireError):
            ask(data)
