"""Changing a node's settings while it runs, so that everybody can know of it.

What may change to what is decided in `runtime.config.parameters`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING

import msgspec

from events import ParameterChanged
from runtime.config.parameters import change
from runtime.errors import ConfigError
from runtime.sender import Listener, Sender, Tap
from runtime.tasks import Fault

if TYPE_CHECKING:
    from runtime.supervisor import Supervisor

log = logging.getLogger("visnav.runtime")


class Changing:
    """Changes settings of a run's nodes, and says so in an event.

    Args:
        supervisor: Of the run.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self.sender = Sender("run.parameters", ParameterChanged)

    def connect(self, heard: Iterable[Listener], taps: Iterable[Tap], fault: Fault) -> None:
        """Say who hears of changes: all that can, those of the changed node too."""
        self.sender.connect(heard, taps, fault)

    def set(self, text: str) -> dict[str, str]:
        """Change a setting now, between two steps.

        Args:
            text: ``node.key=value``.

        Returns:
            What changed: each new value, as TOML, by key; nothing if all was so before.

        Raises:
            ConfigError: It cannot be: the message says why, and all is as it was.
        """
        lives = self._supervisor._lives
        node, config, values = change(
            {n: (life.node or life.spec).config for n, life in lives.items()}, text
        )
        if not values:
            return {}
        life = lives[node]
        if life.node is None or not life.started:
            raise ConfigError(f"{text}: expected a node that runs, and {node} does not just now")
        before = life.node.config
        life.node.config = config
        try:
            life.node.on_change(before)
        except ValueError as error:
            life.node.config = before
            raise ConfigError(f"{text}: {node} refuses: {error}") from None
        except BaseException as error:
            self._supervisor.fault(node, error)
        life.spec = msgspec.structs.replace(life.spec, config=config)  # for when it restarts
        for key, value in values.items():
            log.info("%s.%s is now %s", node, key, value)
            now = self._supervisor.clock.now()
            self.sender.send(ParameterChanged(stamp=now, source=node, key=key, value=value))
        return values
