"""Packages beside ours: `events`, optional libraries, and entry points of installed packages.

A package names its entry points in its ``pyproject.toml``; this project does the same for its own:

    [project.entry-points."visnav.commands"]
    fly = "my_package.fly:fly"            # a function as Typer takes it, or a typer.Typer

    [project.entry-points."visnav.nodes"]
    MyNode = "my_package.nodes:MyNode"

    [project.entry-points."visnav.configurations"]
    json = "my_package.settings:read"     # read(text, path, warn): the table of a TOML file of
                                          # ours; `import`, which prints it, may add world="yard"

    [project.entry-points."visnav.sensors"]
    airspeed = "my_package.airspeed:AirspeedSensor"    # a sims.sensors.sensor.Sensor

    [project.entry-points."visnav.readers"]
    mine = "my_package.reader:MyDataset"    # a nodes.data.replay.folders.Dataset; or a
                                            # Reader of trajectories for `judge`, or several

    [project.entry-points."visnav.worlds"]
    maze = "my_package.worlds:maze"         # maze(seed, bare): a mujoco.MjSpec, or a Scene

A file names a node that is listed here by its name, ``type = "MyNode"``, and any other as
``module:Class``.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import subprocess
import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, NamedTuple

from runtime.errors import CommandError


def check_events() -> None:
    """Check where the package `events` comes from.

    Raises:
        ImportError: It is another project's; `name` is then ``runtime``.
    """
    expected = Path(__file__).resolve().parents[1] / "events" / "__init__.py"
    try:
        events = importlib.import_module("events")
        location = Path(events.__file__ or "?").resolve()
        ours = location == expected and hasattr(events, "PoseEstimate")
    except ModuleNotFoundError as error:
        if error.name != "events":
            raise
        location, ours = Path("none"), False
    if not ours:
        over = " installed over it" if location == expected else ""
        raise ImportError(
            f"expected the package events of visnav-runtime in {expected.parent}, found {location}"
            f"{over}: another package of this name stands in the way; remove or rename it",
            name="runtime",
        )


_PROJECT = Path(__file__).parents[1] / "pyproject.toml"
"""Of a checkout; an installed wheel has none."""


def install_command(extra: str) -> str:
    """Return the command to install an extra's libraries, for the message of an error.

    In a checkout, the command names the extra. A wheel's package is in no index, so that its extra
    cannot be asked for by name: there, the command names the libraries.
    """
    if _PROJECT.is_file():
        return f"pip install -e '.[{extra}]'"
    try:
        required = importlib.metadata.requires("visnav-runtime") or []
    except importlib.metadata.PackageNotFoundError:
        required = []
    wanted = [
        name.partition(";")[0].strip()
        for name in required
        if f"extra == '{extra}'" in name.replace('"', "'")
    ]
    return f"pip install {' '.join(repr(name) for name in wanted or [f'visnav-runtime[{extra}]'])}"


def why_missing(library: str) -> str:
    """Return why a worker's library is not importable; empty if importable.

    An installed library is tried in another process: its system libraries may be missing.
    """
    modules: dict[str, Any] = {**sys.modules}
    if modules.get(library):
        return ""
    if library in modules or importlib.util.find_spec(library) is None:  # None: kept from import
        return f"No module named '{library}'"
    command = [sys.executable, "-c", f"import {library}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    last = [f"exit code {done.returncode}", *done.stderr.strip().splitlines()][-1]
    return last if done.returncode else ""


COMMANDS = "visnav.commands"
NODES = "visnav.nodes"
CONFIGURATIONS = "visnav.configurations"
EXAMPLES = "visnav.examples"
PROCESSES = "visnav.processes"
READERS = "visnav.readers"
SENSORS = "visnav.sensors"
WORLDS = "visnav.worlds"
OURS = "visnav-runtime"
_OTHERS_ONLY = (EXAMPLES, SENSORS, WORLDS)  # groups without entry points of the core

EXTENSIONS = {
    "airsim": ("AirsimClient", "AirsimServer", ".json"),
    "bench": ("bench",),
    "estimators": ("Evalio", "OrbSlam3", "Svo", "Vit", "VocabularyTrainer", "vocabulary"),
    "foxglove": ("FoxgloveServer",),
    "machines": ("Peers",),
    "mavlink": ("Mavlink", "Px4"),
    "rerun": ("RerunView",),
}
"""What the extensions of this repository offer: nodes, suffixes of configuration files, commands,
and the processes of a run beside this one."""


def is_ours(package: str) -> bool:
    """Return whether a distribution or package is of this repository."""
    name = package.replace("_", "-")
    return name == OURS or name.removeprefix("visnav-") in EXTENSIONS


def missing_extension(offered: str) -> str:
    """Return the extension that has a node, suffix or command, and what installs it; or ""."""
    for name, offer in EXTENSIONS.items():
        if offered in offer:
            folder = name if name == "bench" else f"extensions/{name}"
            return f"the extension visnav-{name}: pip install ./{folder}"
    return ""


class Offer(NamedTuple):
    """Entry point offered by a package.

    Attributes:
        name: The name of the command, or of the node's class.
        value: ``module:attribute``.
    """

    package: str
    name: str
    value: str

    def load(self) -> Any:
        """Import the module and return the object of the entry point, or raise `CommandError`."""
        try:
            return EntryPoint(self.name, self.value, "").load()
        except Exception as error:  # whatever a package does when it is imported
            raise CommandError(
                f"{self.name} of the package {self.package}: expected {self.value!r} to be "
                f"something to import, found {type(error).__name__}: {error}"
            ) from error


@cache
def _installed() -> Any:
    """Return the entry points of all packages, which take milliseconds to read."""
    return entry_points()


@cache
def offers(group: str) -> tuple[Offer, ...]:
    """Return the entry points of a group: the core's, the extensions', other packages' by name.

    In a checkout this project's come from its ``pyproject.toml``, because the metadata of an
    editable installation is as old as the installation.

    Raises:
        CommandError: There are none of this project: it is not installed.
    """
    offered = [
        Offer(point.dist.name if point.dist else "?", point.name, point.value)
        for point in _installed().select(group=group)
    ]
    offered.sort(key=lambda o: (o.package != OURS, not is_ours(o.package), o.package))
    ours = _declared(group) or [offer for offer in offered if offer.package == OURS]
    if not ours and group not in _OTHERS_ONLY:
        raise CommandError(
            f"expected the package {OURS} to be installed, found no {group} of it: "
            '"pip install ." in its folder installs it'
        )
    return (*ours, *(offer for offer in offered if offer.package != OURS))


def others(group: str) -> tuple[Offer, ...]:
    """Return the entry points of a group of all packages but the core."""
    return tuple(offer for offer in offers(group) if offer.package != OURS)


def extension(group: str, name: str) -> Any:
    """Import and return what an extension offers.

    Raises:
        CommandError: It is not installed, or cannot be imported.
    """
    for offer in _installed().select(group=group, name=name):
        return Offer(offer.dist.name if offer.dist else "?", name, offer.value).load()
    raise CommandError(f"expected {missing_extension(name)}, found no {group} installed")


def _declared(group: str) -> list[Offer]:
    """Return the entry points of this checkout's ``pyproject.toml``; empty without the file."""
    import tomllib

    if not _PROJECT.is_file():
        return []
    project = tomllib.loads(_PROJECT.read_text(encoding="utf-8")).get("project", {})
    if project.get("name") != OURS:
        return []
    declared = project.get("entry-points", {}).get(group, {})
    return [Offer(OURS, name, value) for name, value in declared.items()]
