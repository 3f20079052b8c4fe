"""Changing a node's settings while it runs, and telling every node that listens.

What may change to what is decided in `runtime.config.parameters`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import msgspec

from events import ParameterChanged
from runtime.channels.sender import Listener, Sender, Tap
from runtime.channels.tasks import Fault
from runtime.config.parameters import change
from runtime.errors import ConfigError
from runtime.run.run_state import RunState

log = logging.getLogger("visnav.runtime")


class ParameterServer:
    """Changes settings of a run's nodes, and sends an event for each.

    Args:
        state: Of the run.
        fault: Called with the node and what it raised.
    """

    def __init__(self, state: RunState, fault: Callable[[str, BaseException], None]) -> None:
        self._state = state
        self._fault = fault
        self._sender = Sender("run.parameters", ParameterChanged)

    def connect(self, listeners: Iterable[Listener], taps: Iterable[Tap], fault: Fault) -> None:
        """Connect the listeners to changes: all that can, those of the changed node too."""
        self._sender.connect(listeners, taps, fault)

    def set(self, text: str) -> dict[str, str]:
        """Change a setting now, between two steps.

        Args:
            text: ``node.key=value``.

        Returns:
            What changed: each new value, as TOML, by key; nothing if all was so before.

        Raises:
            ConfigError: It cannot be: the message says why, and all is as it was.
        """
        runners = self._state.runners
        name, config, values = change(
            {n: (runner.node or runner.spec).config for n, runner in runners.items()}, text
        )
        if not values:
            return {}
        runner = runners[name]
        if runner.node is None or not runner.started:
            raise ConfigError(f"{text}: expected a node that runs, and {name} does not just now")
        before = runner.node.config
        runner.node.config = config
        try:
            runner.node.on_change(before)
        except ValueError as error:
            runner.node.config = before
            raise ConfigError(f"{text}: {name} refuses: {error}") from None
        except BaseException as error:
            self._fault(name, error)
        runner.spec = msgspec.structs.replace(runner.spec, config=config)  # for when it restarts
        for key, value in values.items():
            log.info("%s.%s is now %s", name, key, value)
            now = self._state.clock.now()
            self._sender.send(ParameterChanged(stamp=now, source=name, key=key, value=value))
        return values
