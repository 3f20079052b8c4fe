"""Commands before a flight: checks, nodes and settings, and the project's example files."""

from __future__ import annotations

import enum
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.tools.cli.commands import ConfigFile, Overrides, Quiet, warn

if TYPE_CHECKING:
    from rich.tree import Tree

    from runtime.tools.describe import NodeDescription, SettingDescription


def check(config: ConfigFile, overrides: Overrides = None) -> None:
    """Check a file without flying: print a line for each mistake.

    The settings are read, and the nodes are brought up to where the first update would be: worlds,
    recordings and other files are opened, cameras and vehicles announced, and every node says
    whether it finds what it needs. Checked are, among others, names of nodes, cameras, inputs and
    files; that no input is without a sender or a reader; that no two nodes write the same file;
    and that start and waypoints are in free space. What nodes say of what they read, such as a
    carried body of its motion, is printed. Nothing is rendered, written or sent. Ends with 0, or
    with 2 if there is a mistake; what may be meant, as what lint finds, is a warning.
    """
    from runtime.config.reading import load_configuration
    from runtime.run.graph import edges_of
    from runtime.tools import preflight
    from runtime.tools.cli.run import leave_behind
    from runtime.tools.preflight import lint

    settings = load_configuration(config, overrides or [])
    findings = preflight.of_file(settings)
    if not findings.errors:
        nodes = preflight.of_nodes(settings)
        odd = [] if nodes.errors else [str(e) for e in lint(settings, nodes.announcements)]
        warnings = findings.warnings + nodes.warnings + odd
        findings = preflight.Findings(nodes.errors, warnings, nodes.announcements, nodes.facts)
    errors = findings.errors
    for fact in findings.facts:
        print(fact)
    for warning in findings.warnings:
        warn(warning)
    for error in errors:
        print(f"error: {config.name}: {error}", file=sys.stderr)
    if not errors:
        connections = edges_of(settings.nodes)
        print(f"{config}: {len(settings.nodes)} nodes, {len(connections)} connections: right")
    leave_behind(2 if errors else 0)


def graph(
    config: ConfigFile,
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Draw it into this PNG, SVG or PDF instead of printing Mermaid."),
    ] = None,
) -> None:
    """Show the nodes, and the events sent between them."""
    from runtime.config.reading import load_configuration
    from runtime.run.graph import edges_of

    settings = load_configuration(config, overrides or [])
    names = [spec.name for spec in settings.nodes]
    edges = edges_of(settings.nodes)
    if out is None:
        print(mermaid(names, edges))
        return
    draw(names, edges, out)
    print(out)


def mermaid(names: list[str], edges: list[tuple[str, str, str, str, str]]) -> str:
    """Return the graph in Mermaid's language (mermaid.js.org)."""
    lines = ["flowchart LR", *(f"    {name}" for name in names)]
    for (sender, receiver), events in _by_pair(edges).items():
        lines.append(f"    {sender} -- {', '.join(events)} --> {receiver}")
    return "\n".join(lines)


def draw(names: list[str], edges: list[tuple[str, str, str, str, str]], out: Path) -> None:
    """Draw the nodes in layers, senders to the left, an arrow for each connected pair."""
    from matplotlib.figure import Figure

    pairs = _by_pair(edges)
    columns = layers(names, pairs)
    height = max(len(column) for column in columns)
    figure = Figure(figsize=(1 + 3.4 * len(columns), 1 + 1.3 * height), layout="constrained")
    axes: Any = figure.add_subplot()
    axes.set_axis_off()
    axes.set(xlim=(-0.4, len(columns) - 0.6), ylim=(-height / 2 - 0.2, height / 2 + 0.2))
    boxes = {}
    for x, column in enumerate(columns):
        for row, name in enumerate(column):
            y = (len(column) - 1) / 2 - row + 0.25 * (x % 2)  # so that few arrows cross a box
            boxes[name] = axes.text(
                x, y, name, ha="center", va="center", fontsize=11, weight="bold", zorder=3,
                bbox={"boxstyle": "round,pad=0.6", "fc": "#dcebf7", "ec": "#2f6690"},
            )  # fmt: skip
    for (sender, receiver), events in pairs.items():
        tail, head = boxes[sender], boxes[receiver]
        (x0, y0), (x1, y1) = tail.get_position(), head.get_position()
        bend = 0.12 if x0 < x1 else -0.3  # an arrow back goes below those ahead
        axes.annotate(
            "", xy=(x1, y1), xytext=(x0, y0), zorder=2,
            arrowprops={
                "arrowstyle": "-|>", "color": "#5b7083", "shrinkA": 2, "shrinkB": 2,
                "connectionstyle": f"arc3,rad={bend}", "mutation_scale": 14,
                "patchA": tail.get_bbox_patch(), "patchB": head.get_bbox_patch(),
            },
        )  # fmt: skip
        # The middle of the arc: half of its bend from the middle of the chord, in pixels.
        chord = axes.transData.transform([(x0, y0), (x1, y1)])
        (u0, v0), (u1, v1) = chord
        middle = (u0 + u1) / 2 + bend / 2 * (v1 - v0), (v0 + v1) / 2 - bend / 2 * (u1 - u0)
        x, y = axes.transData.inverted().transform(middle)
        label = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        text = "\n".join(events)
        axes.text(x, y, text, fontsize=7, ha="center", va="center", bbox=label, zorder=4)
    figure.savefig(out, dpi=150)


def layers(names: list[str], pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Put nodes into layers, with most arrows going to a later layer.

    A node stands right of all that it listens to; an arrow that would close a circle, looked for
    in the order of the nodes, is left out of account.
    """
    receivers: dict[str, list[str]] = {name: [] for name in names}
    for sender, receiver in pairs:
        receivers[sender].append(receiver)
    finished: list[str] = []
    ahead: dict[str, list[str]] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in ahead:
            return
        ahead[name] = []
        for receiver in receivers[name]:
            if receiver not in (*path, name):
                ahead[name].append(receiver)
                visit(receiver, (*path, name))
        finished.append(name)

    for name in names:
        visit(name, ())
    rank = dict.fromkeys(names, 0)
    for name in reversed(finished):
        for receiver in ahead[name]:
            rank[receiver] = max(rank[receiver], rank[name] + 1)
    return [[name for name in names if rank[name] == n] for n in range(max(rank.values()) + 1)]


def _by_pair(edges: list[tuple[str, str, str, str, str]]) -> dict[tuple[str, str], list[str]]:
    pairs: dict[tuple[str, str], dict[str, None]] = {}
    for sender, _, event, receiver, _ in edges:
        pairs.setdefault((sender, receiver), {})[event] = None
    return {pair: list(events) for pair, events in pairs.items()}


def nodes(
    which: Annotated[
        str | None, typer.Argument(help='A part of its name, or "module:Class".')
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Describe all nodes as one is described.")
    ] = False,
) -> None:
    """List nodes, or describe one: its ports, and its settings with meaning, range and default.

    The list is of all that installed packages offer. Settings that every file may have, whatever
    its nodes, are listed by "python -m runtime settings".
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from runtime.config.reading import find_modules_in, find_node, find_nodes
    from runtime.errors import ConfigError, suggest
    from runtime.tools.describe import describe

    classes = find_nodes(warn)
    shown = {
        name: cls
        for name, cls in classes.items()
        if which is None or which.lower() in f"{name} {cls.__module__}".lower()
    }
    if not shown and which is not None and ":" in which:
        find_modules_in(Path.cwd())
        shown = {which: find_node(which, "nodes")}
    if not shown:
        raise ConfigError(
            f"expected the name of a node, found {which!r}" + suggest(str(which), classes)
        )
    console = Console()
    if which is None and not every:
        table = Table("node", "", box=None, pad_edge=False, show_header=False)
        for name, cls in shown.items():
            table.add_row(f"[bold]{name}[/bold]", escape(describe(cls, name).doc.splitlines()[0]))
        console.print(table)
        return
    for name, cls in shown.items():
        console.print(_tree(describe(cls, name)), highlight=False)


def _tree(node: NodeDescription) -> Tree:
    from rich.markup import escape
    from rich.tree import Tree

    tree = Tree(f"[bold]{node.type}[/bold]\n{escape(node.doc)}")
    for title, ports in (("listens to", node.inputs), ("sends", node.outputs)):
        branch = _branch(tree, title, ports)
        for port in ports:
            details = ", ".join(filter(None, [port.kind, port.delivery]))
            events = " or ".join(port.events)
            line = f"[bold]{port.name}[/bold]  {events} ({details})"
            branch.add(f"{line}\n{escape(port.doc)}".rstrip())
    branch = _branch(tree, "is called", node.ticks)
    for tick in node.ticks:
        branch.add(f"[bold]{tick.name}[/bold]  at {tick.rate}\n{escape(tick.doc)}")
    add_settings(_branch(tree, "settings", node.settings), node.settings)
    return tree


def _branch(tree: Tree, title: str, content: Sequence[object]) -> Tree:
    return tree.add(title) if content else tree


def add_settings(tree: Tree, settings: Iterable[SettingDescription]) -> None:
    """Add settings to a tree, with the settings of each table below."""
    from rich.markup import escape

    for setting in settings:
        default = f"= {setting.default}" if setting.default else ""
        if len(default) > 60:
            default = default[:57] + "…"
        required = "required" if setting.required else ""
        changeable = "can change in a run" if setting.changeable else ""
        details = [setting.type, setting.constraint, required, changeable]
        line = " ".join(filter(None, [default, f"({', '.join(filter(None, details))})"]))
        line = f"[bold]{setting.name}[/bold]  {escape(line)}"
        add_settings(tree.add(f"{line}\n{escape(setting.doc)}".rstrip()), setting.settings)


def settings() -> None:
    """Describe the settings common to all files: of the run, its network, and any node."""
    from rich.console import Console
    from rich.markup import escape
    from rich.tree import Tree

    from runtime.channels.links import LinkConfig
    from runtime.config.model import NetworkConfig, RunConfig
    from runtime.tools.describe import NODE_SETTINGS, describe_settings, summary

    console = Console()
    for title, doc, entries in (
        ("[run]", summary(RunConfig), describe_settings(RunConfig)),
        ("[network]", summary(NetworkConfig), describe_settings(NetworkConfig)),
        ("[[nodes]]", "What every node may have, beside its own settings.", NODE_SETTINGS),
        ("[nodes.links.PORT]", summary(LinkConfig), describe_settings(LinkConfig)),
    ):
        tree = Tree(f"[bold]{escape(title)}[/bold]\n{escape(doc)}")
        add_settings(tree, entries)
        console.print(tree, highlight=False)


def import_(
    files: Annotated[
        list[Path],
        typer.Argument(help="AirSim's settings.json, or Kalibr's camchain.yaml and imu.yaml."),
    ],
    world: Annotated[
        str | None, typer.Option(help="World to fly in: a name, or an MJCF file.")
    ] = None,
) -> None:
    """Print another program's settings or calibration as an equivalent TOML file.

    AirSim's settings.json becomes its vehicles with their sensors; Kalibr's chain of cameras, with
    the file of its IMU after it, a vehicle that carries the rig. What is not honoured is a warning
    on standard error, and a comment at the top of the file.
    """
    import tomli_w

    from runtime.config.reading import text_of
    from runtime.errors import ConfigError
    from runtime.extras import CONFIGURATIONS, offers

    kinds = {offer.name: offer for offer in reversed(offers(CONFIGURATIONS))}
    suffixes = {path.suffix.lower().lstrip(".") for path in files}
    names = " and ".join(path.name for path in files)
    if len(suffixes) > 1 or not suffixes <= kinds.keys():
        suffix_list = ", ".join(f".{kind}" for kind in kinds)
        raise ConfigError(f"import: expected files of one kind ({suffix_list}), found {names}")
    read = kinds[suffixes.pop()].load()
    warnings: list[str] = []
    options = {} if world is None else {"world": world}
    text = "\n".join(text_of(path) for path in files)
    table = read(text, names, warnings.append, **options)
    for line in warnings:
        warn(line)
    print(f"# Made from {names} by `python -m runtime import`.")
    print("".join(f"# {line}\n" for line in warnings))
    print(tomli_w.dumps(table, multiline_strings=True), end="")


def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write; it is printed if not given.")
    ] = None,
) -> None:
    """Write the JSON schema of configuration files, from the types of all listed nodes.

    A file whose first line is "#:schema PATH" is then completed and checked by editors that know
    such schemas, for example with Taplo or Even Better TOML.
    """
    import json

    from runtime.config.reading import find_nodes
    from runtime.tools.describe import schema as schema_of

    text = json.dumps(schema_of(find_nodes(warn)), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    out.write_text(text, encoding="utf-8")
    print(out)


SCHEMA = "config.schema.json"
INSTALLED = Path(__file__).parents[1] / "example_files"
CHECKOUT = Path(__file__).parents[3]


def demo(
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; runs/tour/<time> if not given.")
    ] = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Fly the standard tour, and judge visual odometry (config.toml)."""
    from runtime.tools.cli.run import run

    run(example_files()["config"], out=out, overrides=overrides, quiet=quiet)


def example(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Which one to copy, with or without .toml; all are listed if not given."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to copy it to.")] = Path(),
) -> None:
    """List the examples, or copy an example with its files, to start from.

    The schema of configuration files is written beside it, for editors that complete and check.
    """
    from runtime.errors import expect_known

    examples = example_files()
    if name is None:
        for label, path in examples.items():
            print(f"{label:18} {_about(path)}")
        return
    name = name.removesuffix(".toml")
    expect_known(name, examples, f"expected the name of an example, found {name!r}")
    _copy(examples[name], out, {})


class Language(enum.StrEnum):
    """Languages and ways of an estimator of one's own."""

    PYTHON = "python"
    CPP = "cpp"
    ROS2 = "ros2"


def new_estimator(
    name: Annotated[str, typer.Argument(help="Name of the estimator, and of its files.")],
    language: Annotated[
        Language, typer.Option(help="A node in Python, a C++ program, or a node of ROS 2.")
    ] = Language.PYTHON,
    out: Annotated[Path, typer.Option(help="Folder to write it to.")] = Path(),
) -> None:
    """Begin an estimator of one's own, which flies, tracks and is judged as it is.

    It is the example of that language under another name: an odometry, to be replaced.
    """
    import re

    from runtime.errors import CommandError

    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise CommandError(f"expected a name of small letters, digits and _, found {name!r}")
    class_name = "".join(word.capitalize() for word in name.split("_"))
    replacements = {
        Language.PYTHON: {"own_estimator": name, "OwnEstimator": class_name, '"own"': f'"{name}"'},
        Language.CPP: {
            "outside_cpp": name,
            "odometry.cpp": f"{name}.cpp",
            "FOLDER/odometry": f"FOLDER/{name}",
            "-o odometry": f"-o {name}",
            '"slam"': f'"{name}"',
        },
        Language.ROS2: {"outside_ros2": name},
    }[language]
    replacements["examples/"] = ""
    copied = _copy(example_files()[next(iter(replacements))], out, replacements)
    print(f"try: python -m runtime run {copied}")


def _copy(example: Path, out: Path, replacements: dict[str, str]) -> Path:
    """Copy an example with all that it reads, words replaced, and the schema; return the copy."""
    import re

    from runtime.errors import CommandError

    def renamed(text: str) -> str:
        for text_part, replacement in replacements.items():
            text = text.replace(text_part, replacement)
        return text

    listed = [example, *_read_by(example)]
    files = [path for file in listed for path in (file, *sorted(file.rglob("*"))) if path.is_file()]
    targets = [out / renamed(str(file.relative_to(example.parent))) for file in files]
    if existing := [target for target in targets if target.exists()]:
        raise CommandError(f"{existing[0]}: expected no file of this name, found one")
    for file, target in zip(files, targets, strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        data = file.read_bytes()
        if replacements or file.suffix == ".toml":
            text = re.sub(r"\A#:schema .*", f"#:schema {SCHEMA}", renamed(data.decode()))
            data = text.encode()
        target.write_bytes(data)
        print(target)
    schema(out / SCHEMA)  # of the nodes installed now: one from before is replaced
    return targets[0]


def example_files() -> dict[str, Path]:
    """Return the examples by name, or raise `CommandError`; the standard tour is ``config``."""
    from importlib.util import find_spec

    from runtime.errors import CommandError
    from runtime.extras import EXAMPLES, offers

    if INSTALLED.is_dir():
        files = list(INSTALLED.glob("*.toml"))
    else:
        files = [CHECKOUT / "config.toml", *(CHECKOUT / "examples").glob("*.toml")]
    if not files or not all(file.is_file() for file in files):
        raise CommandError(f"expected examples in {INSTALLED}, found none: install the project")
    for offer in offers(EXAMPLES):
        spec = find_spec(offer.value)
        for package in map(Path, spec.submodule_search_locations or () if spec else ()):
            folder = package / "examples"  # in a checkout beside the package
            files += (folder if folder.is_dir() else package.with_name("examples")).glob("*.toml")
    files.sort(key=lambda file: (file.stem != "config", file.name))
    return {file.stem: file for file in files}


def _about(path: Path) -> str:
    comment = []
    for line in path.read_text(encoding="utf-8").splitlines():
        text = line.removeprefix("#").strip()
        if text.startswith(":schema"):
            continue
        if not line.startswith("#") or not text:
            break
        comment.append(text)
    return " ".join(comment).partition(". ")[0].rstrip(".:")


def _read_by(path: Path) -> list[Path]:
    """Return files named in an example: worlds, trajectories, node modules, programs."""
    text = path.read_text(encoding="utf-8")
    beside = (file for file in sorted(path.parent.iterdir()) if file.suffix != ".toml")
    return [
        file
        for file in beside
        if f'"{file.name}"' in text or (file.suffix == ".py" and f'"{file.stem}:' in text)
    ]
