"""Descriptions say of a node all that its declarations say."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import msgspec
import pytest

from events import DepthImage, Event, Image, Score
from runtime import Bundle, Changeable, Duration, Input, Node, NodeConfig, Output, every, on
from runtime.tools.describe import NodeDescription, attribute_docs, describe, describe_settings
from runtime.units import Latency


class PartConfig(NodeConfig):
    """A part.

    Attributes:
        name: Which one.
        share: How much of it
            there is.
    """

    name: Annotated[str, msgspec.Meta(min_length=1)]
    share: Changeable[Annotated[float, msgspec.Meta(ge=0, le=1)]] = 0.5


class SampleConfig(NodeConfig):
    """Settings.

    Attributes:
        mode: How.
        latency: How late.
    """

    mode: Literal["a", "b"]
    rate: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    latency: Latency = Latency(0.04)
    wait: Duration | None = None
    place: tuple[float, float] = (0.0, 1.0)
    names: tuple[str, ...] = ("x",)
    digest: bool = True
    part: PartConfig | None = None
    parts: tuple[PartConfig, ...] = ()


class Pair(NamedTuple):
    image: Image
    depth: DepthImage | None


class Sample(Node[SampleConfig]):
    """Does a little.

    And more.

    Attributes:
        images: What it looks at.
    """

    images = Input(Image, keep="latest")
    all_images = Input(Image, bound=7)
    pairs = Bundle(Pair)
    scores = Output(Score)

    @on(Image, DepthImage)
    def measurements(self, event: Event) -> None:
        """Count what comes."""

    @every(hz="rate")
    def tick(self) -> None:
        """Go on."""

    @every(hz=2.5)
    def rest(self) -> None:
        """Do nothing."""


@pytest.fixture(scope="module")
def sample() -> NodeDescription:
    return describe(Sample, "here:Sample")


def test_ports_have_events_delivery_and_docstrings(sample: NodeDescription) -> None:
    ports = {port.name: port for port in sample.inputs}
    assert list(ports) == ["images", "all_images", "pairs.image", "pairs.depth", "measurements"]
    assert {name: port.kind for name, port in ports.items()} == {
        "images": "input",
        "all_images": "input",
        "pairs.image": "bundle",
        "pairs.depth": "bundle",
        "measurements": "handler",
    }
    assert ports["images"].doc == "What it looks at."
    assert ports["images"].delivery == "only the newest is kept"
    assert ports["all_images"].delivery == "up to 7 wait; more is an error"
    assert "sensor_msgs/Image" in ports["all_images"].doc  # the event's own
    assert (ports["pairs.image"].delivery, ports["pairs.depth"].delivery) == (
        "required",
        "optional",
    )
    assert ports["measurements"].events == ("Image", "DepthImage")
    assert ports["measurements"].doc == "Count what comes."
    assert [(port.name, port.events) for port in sample.outputs] == [("scores", ("Score",))]


def test_ticks_have_rates(sample: NodeDescription) -> None:
    assert [(tick.name, tick.rate) for tick in sample.ticks] == [
        ("tick", "the setting rate"),
        ("rest", "2.5 Hz"),
    ]


def test_settings_have_types_ranges_and_defaults(sample: NodeDescription) -> None:
    settings = {s.name: (s.type, s.default, s.constraint) for s in sample.settings}
    assert settings == {
        "mode": ('"a" or "b"', "", ""),
        "rate": ("float", "10.0", "> 0"),
        "latency": ("duration", "0.04", "≥ 0 s; above 1 s with a unit"),
        "wait": ("duration", "", "≥ 0 s"),
        "place": ("list of 2 float", "[0.0, 1.0]", ""),
        "names": ("list of string", '["x"]', ""),
        "digest": ("true or false", "true", ""),
        "part": ("table", "", ""),
        "parts": ("list of table", "", ""),
    }
    assert [s.name for s in sample.settings if s.required] == ["mode"]
    assert sample.settings[0].doc == "How."
    name, share = sample.settings[-1].settings
    assert name.constraint == "at least 1 characters"
    assert (share.doc, share.constraint) == ("How much of it there is.", "≥ 0, ≤ 1")
    assert (name.changeable, share.changeable) == (False, True)
    assert describe_settings(PartConfig) == (name, share)


def test_a_description_is_text_only(sample: NodeDescription) -> None:
    encoded = msgspec.json.encode(sample)
    assert msgspec.json.decode(encoded, type=NodeDescription) == sample


def test_docs_of_attributes_are_one_line() -> None:
    assert attribute_docs(PartConfig) == {"name": "Which one.", "share": "How much of it there is."}
