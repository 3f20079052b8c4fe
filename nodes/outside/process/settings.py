"""Settings of a program that runs beside the run."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Annotated, Literal

import msgspec

from nodes.estimators import EstimatorConfig
from runtime import Duration
from runtime.channels.hold import HoldConfig
from runtime.paths import InputPath


class FileConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that is written for the program before it starts.

    Attributes:
        path: In the program's folder of the run, ``$VISNAV_FOLDER``.
        template: A jinja2 template; docs/how-to/judge-your-slam.md says what may be used in it.
    """

    path: str
    template: InputPath

    def __post_init__(self) -> None:
        path = PurePosixPath(self.path)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise ValueError(f"path: expected one below $VISNAV_FOLDER, found {self.path!r}")


class ProcessConfig(EstimatorConfig):
    """Settings of a program that runs beside the run.

    Attributes:
        command: The program and its arguments, started without a shell; ``$VISNAV_FOLDER`` and
            other variables may stand in them. If empty, it is started by hand: the log says where
            it has to connect.
        build: A command that is run before, in the same folder; the run ends if it fails.
        folder: Working folder; if empty, that in which the run is started.
        environment: Variables beside those of the run, ``VISNAV_FOLDER`` (where the program may
            write, in the run's folder), ``VISNAV_SOCKET``, ``VISNAV_INCLUDE`` (with
            visnav_link.hpp and client.py) and ``VISNAV_PYTHON`` (the run's own interpreter).
        feed: ``link``: the program connects to ``$VISNAV_SOCKET``, see docs/reference/link.md.
            ``ros2``: a `Ros2Bridge` of the run feeds it, and holds for its answers.
        images: Kinds of image that it gets, of each camera.
        cameras: Cameras whose images of one exposure it gets together, as those of a stereo rig:
            sources, or last parts of them. The poses are the first one's. If empty, the first
            camera that gives the `images`.
        method: Name of the method, for the report; if empty, that of the program.
        scale_free: Whether the unit of its poses is its own, as that of a single camera is.
        hold: How long simulated time waits for its answers, and what if none comes. Of a program
            that ROS 2 feeds, that stands at the subscriptions of the bridge.
        files: What is written before it starts.
        timeout: Real seconds within which it must have connected.
        grace: Real seconds that it gets to end after the last frame, and again after SIGTERM.
    """

    command: tuple[str, ...] = ()
    build: tuple[str, ...] = ()
    folder: InputPath = ""
    environment: dict[str, str] = msgspec.field(default_factory=dict)
    feed: Literal["link", "ros2"] = "link"
    images: Annotated[tuple[Literal["rgb", "grey", "depth"], ...], msgspec.Meta(min_length=1)] = (
        "rgb",
        "depth",
    )
    cameras: tuple[str, ...] = ()
    method: str = ""
    scale_free: bool = False
    hold: HoldConfig = HoldConfig()
    files: tuple[FileConfig, ...] = ()
    timeout: Duration = Duration(30.0)  # immutable
    grace: Duration = Duration(2.0)

    def __post_init__(self) -> None:
        if self.feed == "ros2" and not self.command:
            raise ValueError("command: expected one for a program that ROS 2 feeds, found none")
        for name in ("images", "cameras"):
            if len({*getattr(self, name)}) < len(getattr(self, name)):
                raise ValueError(f"{name}: expected each once, found {getattr(self, name)}")
