"""MkDocs hook for the documentation pages made from the code.

Commands, nodes and the tables of a file are read from their typed declarations, the drawing of
the architecture from the imports, each time the site is built: so they cannot drift.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from events.sensors import SENSOR_KINDS
from nodes.ros2.messages.mappings import PUBLISHED, READERS
from runtime.channels.links import LinkConfig
from runtime.config.model import NetworkConfig, RunConfig
from runtime.config.reading import find_nodes
from runtime.figures import FIGURES
from runtime.node import Node
from runtime.tools.cli import app
from runtime.tools.describe import SettingDescription, describe, describe_settings

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    for path, content in {
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
        "reference/nodes.md": nodes_page(find_nodes(_refuse)),
        "explanation/architecture.svg": architecture(imports_between_rooms()),
    }.items():
        files.append(File.generated(config, path, content=content))
    for page in sorted(ROOT.glob("extensions/*/docs/*.md")):
        name = f"extensions/{page.parts[-3]}/{page.name}"
        files.append(File.generated(config, name, abs_src_path=str(page)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the placeholders of tables, and links that leave a folder of pages.

    Pages of extensions stand in ``extensions/NAME/docs``, and in the site in ``extensions/NAME``.
    """
    for pattern, content in _GENERATED.items():
        if match := re.search(pattern, markdown):
            markdown = markdown.replace(match[0], content())
    markdown = re.sub(r"\]\((?:\.\./){3}docs/", "](../../", markdown)
    return re.sub(r"\]\(\.\./((?:\.\./)?extensions/\w+)/docs/", r"](\1/", markdown)


def figures_section() -> str:
    """Return the section on all figures: meanings, units and thresholds."""
    rows = [
        (
            f"`{figure.name}`",
            figure.meaning,
            figure.unit,
            f"at {figure.limit} {'' if figure.default is None else f'{figure.default:g}'}".rstrip()
            if figure.limit
            else "",
        )
        for figure in FIGURES.values()
    ]
    head = ("figure", "what it is", "unit", "threshold, and its default")
    return "\n".join(["## All figures", "", *_table(head, rows)])


_LISTS = {"range": "range_finders", "lidar": "lidars"}
"""Settings of sensors of which a vehicle has several."""


def sensors_table() -> str:
    """Return the table of the sensors: setting, output, event and announcement."""
    rows = [
        tuple(
            f"`{name}`"
            for name in (
                _LISTS.get(kind.name, kind.name),
                kind.group,
                kind.event.__name__,
                kind.announcement.__name__,
            )
        )
        for kind in SENSOR_KINDS.values()
    ]
    return "\n".join(_table(("sensor", "output", "event", "announcement"), rows))


def mappings_tables() -> str:
    """Return the tables of the messages that are published, and of those that are read."""
    published = [
        (
            f"`{row.topic.format('<source>')}`",
            f"`{row.type}`",
            ", ".join(f"`{event.__name__}`" for event in row.events) or "the run",
            f"`{row.group}`",
        )
        for row in PUBLISHED
    ]
    read = [
        (f"`{use}`", f"`{type_}`", "a replay of a bag" if row.bags else "a bridge")
        for (type_, use), row in sorted(READERS.items(), key=lambda item: item[0][1])
    ]
    lines = [
        *_table(("topic", "message", "events", "group (`publish`)"), published),
        "",
        *_table(("becomes (`as`)", "message", "read by"), read),
    ]
    return "\n".join(lines)


_GENERATED: dict[str, Callable[[], str]] = {
    "<!-- all figures.*-->": figures_section,
    "<!-- all sensors.*-->": sensors_table,
    "<!-- all mappings.*-->": mappings_tables,
}
"""Placeholders on the pages, and what stands there on the site."""


def _refuse(warning: str) -> None:
    raise PluginError(warning)


# Commands


def commands_page() -> str:
    """Return the page of all commands, with their arguments and options."""
    lines = [
        "# Commands",
        "",
        "`visnav COMMAND` and `python -m runtime COMMAND` are the same. Exit codes: 0, the command "
        "ended in order; 1, a run missed a threshold; 2, an error, which is one line on standard "
        "error that says what was expected, what was found and where.",
    ]
    group: Any = typer.main.get_command(app)
    context = typer.Context(group, info_name="visnav")
    for name in group.list_commands(context):
        _, command, _ = group.resolve_command(context, [name])
        lines += ["", f"## {name}", "", _prose(command.help or ""), ""]
        rows = [
            (_option(parameter), getattr(parameter, "help", None) or "", _default(parameter))
            for parameter in command.params
            if parameter.name != "help"
        ]
        lines += _table(("argument or option", "meaning", "default"), rows)
    return "\n".join(lines) + "\n"


def _option(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{(parameter.name or '').upper()}`"
    return ", ".join(f"`{option}`" for option in (*parameter.opts, *parameter.secondary_opts))


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    plain = value is not None and value is not False and not callable(value)
    return f"`{getattr(value, 'value', value)}`" if plain and "UNSET" not in repr(value) else ""


# The file and its nodes


def configuration_page() -> str:
    """Return the page of a configuration file's settings, apart from the nodes'."""
    text = (ROOT / "tools" / "configuration.md").read_text(encoding="utf-8")
    tables: dict[str, type[msgspec.Struct]]
    tables = {"run": RunConfig, "network": NetworkConfig, "link": LinkConfig}
    for key, cls in tables.items():
        text = text.replace(f"{{{{ {key} }}}}", "\n".join(_settings(describe_settings(cls))))
    return text


def nodes_page(nodes: dict[str, type[Node[Any]]]) -> str:
    """Return the page of all nodes: purposes, ports and settings."""
    lines = [
        "# Nodes",
        "",
        "Every node that comes with the project, with its ports and settings. `visnav nodes NAME` "
        "prints the same, also for nodes of your own (`visnav nodes my_module:MyNode`). What all "
        "nodes have in common (`name`, `type`, `on_error`, `inputs`, `links`) is in "
        "[Configuration](configuration.md).",
    ]
    for name, cls in nodes.items():
        node = describe(cls, name)
        lines += ["", f"## {cls.__name__}", "", "```toml", f'type = "{name}"', "```", ""]
        lines += [_prose(node.doc), ""]
        lines += _table(
            ("port", "kind", "events", "meaning"),
            [
                (
                    f"`{port.name}`",
                    f"{port.kind}, {port.delivery}" if port.delivery else port.kind,
                    ", ".join(f"`{event}`" for event in port.events),
                    _prose(port.doc),
                )
                for port in (*node.inputs, *node.outputs)
            ],
        )
        rates = [(f"`{tick.name}`", tick.rate, _prose(tick.doc)) for tick in node.ticks]
        lines += ["", *_table(("called", "at", "what it does"), rates)]
        lines += ["", *_settings(node.settings)]
        if cls.files:
            files = ", ".join(f"`{file}`" for file in cls.files)
            lines += ["", f"Writes into the run's folder: {files}."]
    return "\n".join(lines) + "\n"


def _settings(settings: tuple[SettingDescription, ...], table: str = "") -> list[str]:
    """Return a table of settings; those of a table or of a list of tables follow below."""
    rows = []
    for setting in settings:
        default = "required" if setting.required else setting.default and f"`{setting.default}`"
        change = " It can be changed in a run." if setting.changeable else ""
        type_ = f"{setting.type}, {setting.constraint}" if setting.constraint else setting.type
        rows.append((f"`{table}{setting.name}`", type_, default, _prose(setting.doc) + change))
    lines = _table(("setting", "type", "default", "meaning"), rows)
    for setting in settings:
        if setting.settings:
            lines += ["", *_settings(setting.settings, f"{table}{setting.name}.")]
    return lines


# The architecture

PLACES = {
    "bench": (0, 0), "sims": (-1, 1), "nodes": (1, 1), "runtime.tools": (1, 2), "runtime": (0, 3),
    "events": (0, 4),
}  # fmt: skip
"""Column and row of each room; a room may import only from rows below."""

ABOUT = {
    "bench": "benchmarks and their peers:", "sims": "simulators:", "nodes": "what else plugs in:",
    "runtime.tools": "round the core:", "runtime": "the core:", "events": "frozen typed data",
}  # fmt: skip


def imports_between_rooms() -> set[tuple[str, str]]:
    """Return pairs of rooms (importer, imported), read from all source files."""
    pairs = set()
    for path in sorted(file for room in ABOUT for file in (ROOT / room).rglob("*.py")):
        if path.name == "__main__.py":  # it starts the command line
            continue
        room = _room(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                modules = [f"{node.module}.{alias.name}" for alias in node.names]
            pairs |= {(room, _room(module)) for module in modules}
    return {(one, other) for one, other in pairs if one != other and one and other}


def _room(module: str) -> str:
    return next((r for r in ABOUT if r.count(".") and f"{module}.".startswith(f"{r}.")), None) or (
        module.partition(".")[0] if module.partition(".")[0] in ABOUT else ""
    )


def _folders(room: str) -> list[str]:
    folder = ROOT / room.replace(".", "/")
    inside = sorted(path.parent.name for path in folder.glob("*/__init__.py"))
    return textwrap.wrap(f"{ABOUT[room]} {', '.join(i for i in inside if i != 'tools')}", 56)


def architecture(imports: set[tuple[str, str]]) -> str:
    """Return the rooms and imports as SVG; `PluginError` for an import of a room not below."""
    for one, other in sorted(imports):
        if PLACES[one][1] >= PLACES[other][1]:
            raise PluginError(f"{one} imports {other}, which does not lie below it")
    shown = {
        (one, other)
        for one, other in imports
        if not any((one, way) in imports and (way, other) in imports for way in ABOUT)
    }
    width, height = 300, 64
    place = {room: (340 + 170 * column, 40 + 95 * row) for room, (column, row) in PLACES.items()}
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 680 450" '
        'font-family="sans-serif" text-anchor="middle">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto"><path d="M0 0 8 4 0 8z" fill="#607d8b"/></marker></defs>',
    ]
    for one, other in sorted(shown):
        (x0, y0), (x1, y1) = place[one], place[other]
        parts.append(
            f'<line x1="{x0:.0f}" y1="{y0 + height / 2:.0f}" x2="{x1 + (x0 - x1) / 8:.0f}" '
            f'y2="{y1 - height / 2 - 2:.0f}" stroke="#607d8b" stroke-width="1.5" '
            'marker-end="url(#tip)"/>'
        )
    for room, (x, y) in place.items():
        parts.append(
            f'<rect x="{x - width / 2:.0f}" y="{y - height / 2:.0f}" width="{width}" '
            f'height="{height}" rx="6" fill="#eceff1" stroke="#607d8b"/>'
            f'<text x="{x:.0f}" y="{y - 11:.0f}" font-size="15" font-weight="bold">{room}</text>'
        )
        parts += [
            f'<text x="{x:.0f}" y="{y + 7 + 14 * index:.0f}" font-size="10">{line}</text>'
            for index, line in enumerate(_folders(room))
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


# Markdown


def _prose(text: str) -> str:
    """Return a docstring's text before its sections as Markdown, with single backticks."""
    text = re.split(r"^(?:Args|Attributes|Raises|Returns):$", text, flags=re.MULTILINE)[0]
    text = re.sub(r"^::$|:(?=:$)", "", text, flags=re.MULTILINE)  # what follows is indented
    text = re.sub(r"``([^`]+)``", r"`\1`", text).strip()
    # An angle bracket outside code would be read as HTML.
    return re.sub(r"(`[^`]*`|^ {4}.*$)|<", lambda m: m[1] or "&lt;", text, flags=re.MULTILINE)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    if not rows:
        return []
    cells = [" | ".join(" ".join(c.split()).replace("|", "\\|") for c in row) for row in rows]
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {row} |" for row in cells)]
