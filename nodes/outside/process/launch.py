"""Start of an external program: its settings, folder, environment and files.

Settings of a program that runs beside the run.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import jinja2
import msgspec

from nodes.calibration.formats import left_out, write_files
from nodes.calibration.kannala_brandt import with_kannala_brandt
from nodes.data.dataset.recording import Rig, templates
from nodes.estimators import EstimatorConfig
from nodes.outside import native
from nodes.outside.process.program import Program
from runtime import Duration
from runtime.channels.hold import HoldConfig
from runtime.errors import VisnavError
from runtime.paths import InputPath
from runtime.sensors import sensor_kinds


class FileConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file written for the program before its start.

    Attributes:
        path: In the program's folder of the run, ``$VISNAV_FOLDER``.
        template: A jinja2 template; its variables are in docs/how-to/judge-your-slam.md.
    """

    path: str
    template: InputPath

    def __post_init__(self) -> None:
        path = PurePosixPath(self.path)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise ValueError(f"path: expected one below $VISNAV_FOLDER, found {self.path!r}")


class ProcessConfig(EstimatorConfig):
    """Settings of an external program.

    Attributes:
        command: The program and its arguments, started without a shell; ``$VISNAV_FOLDER`` and
            other variables are replaced. If empty, it is started by hand: the log says where it
            has to connect.
        build: A command run before, in the same folder; the run ends if it fails.
        folder: Working folder; if empty, that in which the run is started.
        environment: Variables beside those of the run, ``VISNAV_FOLDER`` (where the program may
            write, in the run's folder), ``VISNAV_SOCKET``, ``VISNAV_INCLUDE`` (with
            visnav_link.hpp and client.py) and ``VISNAV_PYTHON`` (the run's own interpreter).
        feed: ``link``: the program connects to ``$VISNAV_SOCKET``, see docs/reference/link.md.
            ``ros2``: a `Ros2Bridge` of the run feeds it, and holds for its answers.
        images: Kinds of image to send, of each camera; none for a program that `asks` otherwise.
        cameras: Cameras whose images of one exposure are sent together, as of a stereo rig:
            sources, or last parts of them. Poses are of the first. If empty, the first camera
            that gives the `images`.
        reads: What is sent besides: {sensors} (the first of the vehicle), the last part of a
            sensor's source, or an estimator, whose estimates are sent when they come, at its
            latency. The IMU of the camera's body comes unasked.
        asks: Input each of whose measurements asks for an answer, at their stamp; if empty, the
            images do.
        every: Every how many of these.
        outputs: Names of further poses that it answers with, each judged by itself as
            ``<node>/<name>``.
        pilot: Whether it flies the vehicle by orders.
        vehicle: Whose sensors are meant, and who gets the orders; if empty, the camera's or first.
        calibration: Format of the calibration's files (see ``export``), which are written into
            ``$VISNAV_FOLDER``; if empty, none. ``basalt_kb4`` is for a Basalt that knows no
            radial-tangential lens: the nearest Kannala-Brandt lens takes its place.
        cpus: Processors that it may use, 0 for all; with 1, threads that share sums add up in the
            same order more often than not.
        method: Name of the method in the report; if empty, that of the program.
        scale_free: Whether the unit of its poses is arbitrary, as with a single camera.
        hold: How long simulated time waits for an answer, and what follows if none comes. With
            ``ros2``, set it at the subscriptions of the bridge instead.
        files: Files written before the program starts.
        timeout: Real seconds for the program to connect.
        grace: Real seconds to send a promised trajectory after the last frame, to end, and again
            after SIGTERM.
    """

    command: tuple[str, ...] = ()
    build: tuple[str, ...] = ()
    folder: InputPath = ""
    environment: dict[str, str | int | float] = msgspec.field(default_factory=dict)
    feed: Literal["link", "ros2"] = "link"
    images: tuple[Literal["rgb", "grey", "depth"], ...] = ("rgb", "depth")
    cameras: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    asks: str = ""
    every: Annotated[int, msgspec.Meta(ge=1)] = 1
    outputs: tuple[str, ...] = ()
    pilot: bool = False
    vehicle: str = ""
    calibration: Literal["", "kalibr", "openvins", "vins", "basalt", "basalt_kb4", "orbslam3"] = ""
    cpus: Annotated[int, msgspec.Meta(ge=0)] = 0
    method: str = ""
    scale_free: bool = False
    hold: HoldConfig = HoldConfig()
    files: tuple[FileConfig, ...] = ()
    timeout: Duration = Duration(30.0)  # immutable
    grace: Duration = Duration(2.0)

    def __post_init__(self) -> None:
        if self.feed == "ros2" and not self.command:
            raise ValueError("command: expected one for a program that ROS 2 feeds, found none")
        if self.feed == "link" and bool(self.images) == bool(self.asks):
            settings = f"asks = {self.asks!r} and images = {list(self.images)}"
            raise ValueError(f"asks: expected images or the input that asks, found {settings}")
        for name in ("images", "cameras", "reads", "outputs"):
            if len({*getattr(self, name)}) < len(getattr(self, name)):
                raise ValueError(f"{name}: expected each once, found {getattr(self, name)}")


ProcessConfig.__doc__ = str(ProcessConfig.__doc__).replace(
    "{sensors}", ", ".join(f"``{kind.name}``" for kind in sensor_kinds())
)


_KB4 = "basalt_kb4"
_LONGEST = 100  # bytes of a socket's path; Linux allows 107


class ProgramError(VisnavError):
    """A program cannot be started, does not connect, or has ended."""


class Launch:
    """Start of a program: its folder, environment and files.

    Args:
        bridge: Settings of the bridge that feeds it, if one does.
        folder: Where it may write; `None` for a folder that is removed afterwards.
    """

    def __init__(self, config: ProcessConfig, bridge: Any, folder: Path | None) -> None:
        self.working = Path(config.folder).absolute()  # its working folder
        self._config = config
        self._processors: Sequence[int] = ()
        self._temporary: Path | None = None
        self._folder = folder and folder.absolute()
        self.folder = self._folder or Path("folder")
        # Where it has to connect: in its folder, if the path is not too long for one.
        self.socket = self.folder / "link.socket"
        if bridge is None:
            self._ros_environment = {}
        else:
            router = [*(bridge.listen or bridge.connect or ["tcp/localhost:7447"])]
            self._ros_environment = {
                "ROS_DOMAIN_ID": str(bridge.domain_id),
                "RMW_IMPLEMENTATION": "rmw_zenoh_cpp",
                "ZENOH_CONFIG_OVERRIDE": f"connect/endpoints={json.dumps(router)}",
            }

    def missing(self, setting: str, command: Sequence[str]) -> str:
        """Return an error if a command cannot be started; empty otherwise."""
        if not self.working.is_dir():
            return f"folder: expected a folder, found none at {self.working}"
        program = self._expanded(command[0])
        place = str(self.working / program) if "/" in program else program
        if shutil.which(place, path=self.environment().get("PATH")) is not None:
            return ""
        return f"{setting}: expected a program that can be executed, found none at {place}"

    def take_processors(
        self,
        used: list[int],  # those chosen by others; this program's are added
    ) -> str:
        """Choose the processors, the least used first; return an error if there are too few."""
        processors, count = sorted(os.sched_getaffinity(0), reverse=True), self._config.cpus
        if count > len(processors):
            return f"cpus: expected at most the {len(processors)} there are, found {count}"
        self._processors = sorted(processors, key=used.count)[:count]
        used += self._processors
        return ""

    def make_folder(self, *, fresh: bool) -> None:
        """Create the program's folder; `fresh` removes old content."""
        if self._folder is None or len(os.fsencode(self.socket)) > _LONGEST:
            self._temporary = Path(tempfile.mkdtemp(prefix="visnav-"))
            self.socket = self._temporary / "link.socket"
        self.folder = self._folder or self.socket.parent
        if fresh and self._temporary is None and self.folder.is_dir():
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def start(
        self,
        command: Sequence[str],
        printed: Callable[[str], None],
        ended: Callable[[str], None] = lambda _: None,
    ) -> Program:
        """Start a command; see `Program`."""
        return Program(
            [self._expanded(word) for word in command],
            self.working,
            self.environment(),
            grace=self._config.grace,
            processors=self._processors,
            printed=printed,
            ended=ended,
        )

    def close(self) -> None:
        """Remove the temporary folder, if any."""
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def environment(self) -> dict[str, str]:
        """Return all variables of the program."""
        places = {
            "VISNAV_FOLDER": str(self.folder),
            "VISNAV_SOCKET": str(self.socket),
            "VISNAV_INCLUDE": str(Path(native.__file__).parent),
            "VISNAV_PYTHON": sys.executable,
        }
        settings = {name: str(value) for name, value in self._config.environment.items()}
        return {**os.environ, **places, **self._ros_environment, **settings}

    def _expanded(self, word: str) -> str:
        environment = self.environment()
        return re.sub(r"\$(?:(\w+)|{(\w+)})", lambda m: environment.get(m[1] or m[2], m[0]), word)

    def remarks(self, rig: Rig | None) -> list[str]:
        """Return what the calibration's files do not say, or say otherwise, a sentence each."""
        form = self._config.calibration
        if rig is None or not form:
            return []
        fitted = with_kannala_brandt(rig)[1] if form == _KB4 else []
        return [*left_out(rig, "basalt" if form == _KB4 else form), *fitted]

    def texts(self, variables: Mapping[str, Any], rig: Rig | None) -> dict[Path, str]:
        """Return the texts of the program's files, by path.

        Args:
            variables: Variables of the templates, by name.
            rig: Sensors of the calibration; `None` if there are no cameras.

        Raises:
            ProgramError: A template is missing or wrong, or the calibration's format has no word
                for the sensors.
        """
        texts: dict[Path, str] = {}
        if form := self._config.calibration:
            if rig is None:
                raise ProgramError("calibration: expected a camera, found none")
            try:
                if form == _KB4:
                    rig, form = with_kannala_brandt(rig)[0], "basalt"
                files = write_files(rig, form, topics=self._config.feed == "ros2")
            except ValueError as error:
                raise ProgramError(f"calibration: {error}") from None
            texts = {self.folder / name: text for name, text in files.items()}
        for file in self._config.files:
            template = Path(file.template)
            try:
                ready = templates(template.parent).get_template(template.name)
                texts[self.folder / file.path] = ready.render(variables)
            except jinja2.TemplateNotFound as error:
                missing = template.parent / str(error.name)
                raise ProgramError(f"files: {missing}: expected a template, found none") from None
            except (jinja2.TemplateError, ValueError, TypeError, ArithmeticError) as error:
                line = getattr(error, "lineno", None)
                place = f"{template}: line {line}" if line else str(template)
                raise ProgramError(f"files: {place}: {error}") from None
        return texts
