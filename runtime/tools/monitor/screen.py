"""The monitor in a terminal, with Textual.

The only module that imports it.
"""

from __future__ import annotations

import itertools
import time
from typing import Any, ClassVar

import msgspec
import numpy as np
from rich.text import Text

from runtime.errors import MissingDependencyError, VisnavError
from runtime.extras import install_command
from runtime.tools.monitor import protocol

try:
    from textual.app import App, ComposeResult
    from textual.binding import Binding
    from textual.containers import Horizontal, Vertical
    from textual.suggester import SuggestFromList
    from textual.widgets import DataTable, Footer, Input, RichLog, Static
except ImportError:
    raise MissingDependencyError(
        f"the monitor's screen needs textual: {install_command('monitor')}"
    ) from None

CONFIRM = 3.0  # seconds for pressing the key to end a run a second time

_COLOURS = {"WARNING": "yellow", "ERROR": "red", "CRITICAL": "red bold"}
_PATHS = ("white", "bright_magenta", "bright_cyan", "bright_yellow", "bright_green", "bright_red")


class Screen(App[str]):
    """Nodes, channels, clock and log of a run; with `leave`, it exits with the run."""

    CSS = """
    #head { background: $primary; color: $text; height: 1; padding: 0 1; text-style: bold; }
    #tables { height: 1fr; }
    #left { width: 5fr; }
    #right { width: 7fr; }
    DataTable, RichLog, #paths { border: round $primary-darken-2; scrollbar-size: 1 1; }
    DataTable { height: auto; max-height: 50%; }
    DataTable#estimators { max-height: 25%; }
    DataTable#outputs { height: 1fr; max-height: 100%; }
    .none { display: none; }
    #below { height: 30%; min-height: 12; }
    #paths { width: 5fr; height: 100%; }
    RichLog { width: 7fr; height: 100%; }
    .-short #below { height: 5; min-height: 5; }
    .-short DataTable#estimators { max-height: 4; }
    .-short DataTable#nodes { max-height: 8; }
    #prompt { display: none; }
    #prompt.asking { display: block; }
    """
    BINDINGS: ClassVar[list[Any]] = [
        Binding("space", "pause", "pause/go on"),
        Binding("full_stop", "step", "step"),
        Binding("s", "step(1.0)", "step 1 s"),
        Binding("plus,equals_sign", "speed(2.0)", "faster", key_display="+"),
        Binding("minus", "speed(0.5)", "slower", key_display="-"),
        Binding("m", "speed(None)", "fastest"),
        Binding("r", "restart", "restart node"),
        Binding("p", "prompt", "set parameter"),
        Binding("x,ctrl+c", "stop", "end run", key_display="x x"),
        Binding("q", "quit", "quit"),
        Binding("escape", "leave_prompt", show=False),
    ]
    ENABLE_COMMAND_PALETTE = False
    VERTICAL_BREAKPOINTS = [(0, "-short"), (32, "-tall")]  # noqa: RUF012  # Textual's are so

    def __init__(self, connection: protocol.Client, leave: bool = False) -> None:
        super().__init__()
        self._connection = connection
        self._leave = leave
        self.snapshot: protocol.Snapshot | None = None
        self._last_log_line = -1
        self._stop_pressed_at = 0.0

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Static(Text("waiting for the run …"), id="head")
        above, left, right = protocol.STACKS
        yield from map(_table, above)
        with Horizontal(id="tables"):
            with Vertical(id="left"):
                yield from map(_table, left)
            with Vertical(id="right"):
                yield from map(_table, right)
        with Horizontal(id="below"):
            yield Static(id="paths", classes="none")
            yield RichLog(id="log", max_lines=1000, wrap=True)
        yield Input(id="prompt", placeholder="node.key=value", select_on_focus=False)
        yield Footer()

    def on_mount(self) -> None:
        """Begin to listen to the run."""
        self.query_one("#log").border_title = "log"
        self.query_one("#paths").border_title = "from above, north is up"
        for name in protocol.COLUMNS:
            table: DataTable[Text] = self.query_one(f"#{name}", DataTable)
            table.border_title = name
            for title, form in protocol.COLUMNS[name].items():
                table.add_column(_cell(title, form), key=title)
        self.query_one("#nodes").focus()
        self.run_worker(self._listen(), exclusive=True)

    async def _listen(self) -> None:
        reason = ""
        try:
            async for snapshot in self._connection.snapshots():
                self.show(snapshot)
                reason = snapshot.ended
        except VisnavError as error:
            reason = str(error)
        for head in self.query("#head").results(Static):  # none if the screen has closed meanwhile
            head.update(Text(f"the run is over: {reason or 'it does not answer any more'}"))
        if self._leave:
            self.exit()

    def show(self, snapshot: protocol.Snapshot) -> None:
        """Show a snapshot, unless the screen is closing."""
        if not self.query("#head"):
            return
        self.snapshot = snapshot
        self.query_one("#head", Static).update(Text(snapshot.headline))
        for name in protocol.COLUMNS:
            self._fill(name, snapshot)
        paths = self.query_one("#paths", Static)
        paths.set_class(not snapshot.paths, "none")
        paths.update(drawn(snapshot.paths, paths.content_size.width, paths.content_size.height))
        log = self.query_one("#log", RichLog)
        for line in snapshot.log:
            if line.number > self._last_log_line:
                self._last_log_line = line.number
                log.write(Text(line.text, style=_COLOURS.get(line.level, "")), expand=True)

    def _fill(self, name: str, snapshot: protocol.Snapshot) -> None:
        """Update a table's rows in place, to keep the cursor."""
        columns = protocol.COLUMNS[name]
        table: DataTable[Text] = self.query_one(f"#{name}", DataTable)
        rows = {
            row[0]: [_cell(*pair) for pair in zip(row, columns.values(), strict=True)]
            for row in snapshot.tables[name]
        }
        table.set_class(not rows, "none")
        if [*rows] != [key.value for key in table.rows]:
            table.clear()
            for key, cells in rows.items():
                table.add_row(*cells, key=key)
            return
        for key, cells in rows.items():
            for title, cell in zip(columns, cells, strict=True):
                if table.get_cell(key, title) != cell:
                    table.update_cell(key, title, cell, update_width=True)

    # Keys.

    def _ask(self, command: protocol.Command) -> None:
        self.run_worker(self._send(command))

    async def _send(self, command: protocol.Command) -> None:
        answer = await self._connection.ask(command)
        severity = "information" if answer.done else "error"
        self.notify(answer.text, severity=severity, markup=False)  # type: ignore[arg-type]

    def action_pause(self) -> None:
        """Pause or resume time."""
        if self.snapshot is not None:
            paused = self.snapshot.paused
            self._ask(protocol.Resume() if paused else protocol.Pause())
            self._expect(paused=not paused)

    def action_step(self, seconds: float | None = None) -> None:
        """Step by some seconds, or else to the next due time."""
        self._ask(protocol.Step(seconds=seconds))

    def action_speed(self, factor: float | None) -> None:
        """Multiply the speed of time, or let time run as fast as possible."""
        if factor is None:
            self._ask(protocol.Speed())
        elif self.snapshot is not None:
            speed = min(max(self.snapshot.speed * factor, protocol.SLOWEST), protocol.QUICKEST)
            self._ask(protocol.Speed(factor=speed))
            self._expect(speed=speed)

    def _expect(self, **changes: Any) -> None:
        """Assume a command's effect until the next snapshot, for keys pressed before."""
        if self.snapshot is not None and not self.snapshot.fixed:
            self.snapshot = msgspec.structs.replace(self.snapshot, **changes)

    def action_restart(self) -> None:
        """Restart the node under the cursor."""
        if (node := self._selected_node()) is not None:
            self._ask(protocol.Restart(node=node))

    def action_stop(self) -> None:
        """End the run, if the key is pressed twice."""
        now = time.monotonic()
        if now - self._stop_pressed_at < CONFIRM:
            self._ask(protocol.Stop())
        else:
            self.notify("press it again to end the run", severity="warning")
        self._stop_pressed_at = now

    def action_prompt(self) -> None:
        """Ask for a setting of the node under the cursor."""
        if self.snapshot is None:
            return
        settings = ["=".join(row) for row in self.snapshot.tables["settings"]]
        prompt = self.query_one("#prompt", Input)
        prompt.suggester = SuggestFromList(settings)
        of_node = [text for text in settings if text.startswith(f"{self._selected_node()}.")]
        prompt.value = of_node[0].partition("=")[0] + "=" if of_node else ""
        prompt.cursor_position = len(prompt.value)
        prompt.placeholder = settings[0] if settings else "no node has a setting that can change"
        prompt.add_class("asking")
        prompt.focus()

    def action_leave_prompt(self) -> None:
        """Close the prompt."""
        self.query_one("#prompt").remove_class("asking")
        self.query_one("#nodes").focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Set the typed setting."""
        self.action_leave_prompt()
        if event.value.strip():
            self._ask(protocol.Set(text=event.value))

    def _selected_node(self) -> str | None:
        table: DataTable[Text] = self.query_one("#nodes", DataTable)
        if not table.row_count:
            return None
        return table.coordinate_to_cell_key(table.cursor_coordinate).row_key.value


def _table(name: str) -> DataTable[Text]:
    return DataTable(id=name, cursor_type="row", show_cursor=name == "nodes", zebra_stripes=True)


def _cell(text: str, form: str) -> Text:
    return Text(text, justify="right" if form else "left")


def drawn(paths: dict[str, protocol.Points], width: int, height: int) -> Text:
    """Return paths in Braille dots, two by four to a character, and a line with their names.

    Args:
        paths: East and north of their places, metres; of two that cross, the later is above.
    """
    text = Text(no_wrap=True, overflow="ellipsis")
    colours = dict(zip(paths, itertools.cycle(_PATHS), strict=False))
    for name, colour in colours.items():
        text.append(f"━ {name}  ", colour)
    places = np.array([place for path in paths.values() for place in path])
    dots = np.array([2 * width, 4 * (height - 1)]) - 1
    if not len(places) or dots.min() <= 0:
        return text
    low, high = places.min(0), places.max(0)
    metres = max(((high - low) / dots).max(), 0.02)  # by dot; of who stands still, no noise
    corner = (low + high - metres * dots) / 2
    cells: dict[tuple[int, int], tuple[int, str]] = {}
    for name, path in paths.items():
        at = (np.array(path).reshape(-1, 2) - corner) / metres
        for start, end in zip(at[:1].tolist() + at[:-1].tolist(), at.tolist(), strict=True):
            for x, y in np.rint(np.linspace(start, end, 2 + int(np.ptp([start, end], 0).max()))):
                column, line, dot = int(x) // 2, int(dots[1] - y) // 4, int(dots[1] - y) % 4
                bit = (1, 2, 4, 64, 8, 16, 32, 128)[int(x) % 2 * 4 + dot]
                cells[line, column] = (cells.get((line, column), (0, ""))[0] | bit, colours[name])
    for line in range(height - 1):
        text.append("\n")
        for column in range(width):
            bits, colour = cells.get((line, column), (0, ""))
            text.append(chr(0x2800 + bits) if bits else " ", colour)
    return text
