"""Changes of nodes' settings during a run; which may change: `runtime.config.parameters`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import msgspec

from events import ParameterChanged
from runtime.channels.sender import Listener, Sender, Tap
from runtime.channels.tasks import Fault
from runtime.errors import ConfigError
from runtime.run.run_state import RunState

log = logging.getLogger("visnav.runtime")


class Parameters:
    """Changes settings of a run's nodes, and sends an event of each change.

    Args:
        fault: Called with a node's name and what its `on_change` raised.
    """

    def __init__(self, state: RunState, fault: Callable[[str, BaseException], None]) -> None:
        self._state = state
        self._fault = fault
        self._sender = Sender("run.parameters", ParameterChanged)
        self._early: list[ParameterChanged] = []  # of changes before the first update

    def connect(self, listeners: list[Listener], taps: Iterable[Tap], fault: Fault) -> None:
        """Set who receives the events; the listeners include the changed node."""
        self._sender.connect(listeners, taps, fault)

    def set(self, text: str) -> dict[str, str]:
        """Change a setting (``node.key=value``) between two steps; return new values by key.

        Raises:
            ConfigError: It cannot be: the message says why, and all is as it was.
        """
        from runtime.config.parameters import change

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
            changed = ParameterChanged(stamp=now, source=name, key=key, value=value)
            if self._state.running:
                self._sender.send(changed)
            else:
                self._early.append(changed)
        return values

    def send_early(self) -> None:
        """Send the events of changes made while the nodes were starting."""
        early, self._early = self._early, []
        for changed in early:
            self._sender.send(changed)
