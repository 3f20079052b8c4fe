"""Which of a run's vehicles an order is for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from events import Command, PathAnnouncement, PilotAnnouncement, Setpoint
from runtime.errors import suggest
from runtime.host import Sibling

Order = Command | Setpoint | PathAnnouncement | PilotAnnouncement


class Addressee:
    """Decides what a vehicle, or a free camera, obeys.

    An order that names a vehicle is for that one. One that names none is for the only vehicle of
    the run, and for those whose ports are narrowed to its source. A free camera is a vehicle here
    if there is no other.

    Args:
        name: The node's name.
        simulators: All simulators of the run, in file order.
        ports: The node's ports, narrowed to sources.
    """

    def __init__(self, name: str, simulators: Sequence[Sibling], ports: Mapping[str, str]) -> None:
        self._name = name
        self._ports = ports
        self._simulators = simulators
        self._known = [each.name for each in simulators]
        vehicles = [each.name for each in simulators if each.node.vehicle]
        self._vehicles = vehicles or self._known
        self._refused: set[tuple[str, str]] = set()

    def obeys(self, order: Order, port: str) -> bool:
        """Return whether an order that comes to a port, or a pilot's path, is for this vehicle."""
        narrowed = self._ports.get(port)
        if narrowed and not f"{order.source}/".startswith(f"{narrowed}/"):
            return False
        if order.vehicle:
            return order.vehicle == self._name
        return bool(narrowed) or self._vehicles == [self._name]

    def refusal(self, order: Order) -> str:
        """Return, the first time, why an order is for nobody; empty if it is for somebody.

        Only the first of several vehicles does so.
        """
        key = (order.source, order.vehicle)
        if self._vehicles[0] != self._name or key in self._refused:
            return ""
        reason = "" if not order.vehicle and self._narrowed_to(order.source) else self._fault(order)
        if reason:
            self._refused.add(key)
        return reason

    def complaints(self, pilots: Iterable[PilotAnnouncement]) -> Iterator[str]:
        """Yield what is wrong with the vehicles that pilots name; the first vehicle does so."""
        for pilot in pilots:
            if reason := self.refusal(pilot):
                yield f"{pilot.source}: vehicle: {reason}"

    def _fault(self, order: Order) -> str:
        if order.vehicle in self._known or (not order.vehicle and len(self._vehicles) < 2):
            return ""
        found = (
            f'"{order.vehicle}"{suggest(order.vehicle, self._known)}' if order.vehicle else "none"
        )
        return f"expected one of {', '.join(self._vehicles)}, found {found}"

    def _narrowed_to(self, source: str) -> bool:
        return any(
            f"{source}/".startswith(f"{narrowed}/")
            for each in self._simulators
            for port, narrowed in each.sources.items()
            if port in ("commands", "setpoints")
        )
