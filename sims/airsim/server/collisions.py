"""What clients are told of the vehicles' collisions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from events import Collision, VehicleEvent
from sims.airsim.server.methods import rpc
from sims.airsim.server.vehicles import ServedMultirotor, ServedVehicle
from sims.airsim.structures import CollisionInfo, Vector3r
from sims.vehicle.physics import Contact

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

APART = 10
"""Looks, of 20 ms each, without contact with a thing after which the next contact is a new one."""

_ANYTHING: dict[str, int] = {"": 0}
"""What a vehicle that was just put somewhere touches for `APART` looks."""


class Collisions:
    """Notes each vehicle's last collision.

    That is what its node tells of as such; and, since with AirSim contact with the ground counts,
    however gentle, any contact with a thing after a while without one. So standing at the start
    does not count, and landing does; and the ground under it does not hide a wall.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._touched: dict[str, dict[str, int]] = {}
        """By vehicle what it has touched, and how many looks ago."""

    @rpc("simGetCollisionInfo")
    def collision_info(self, vehicle: str) -> CollisionInfo:
        """Return a vehicle's last collision, and count it as read: ``has_collided`` is cleared."""
        served = self._server.find_vehicle(vehicle)
        found = served.collision
        served.collision = msgspec.structs.replace(found, has_collided=False)
        return found

    def forget(self, vehicle: ServedVehicle) -> None:
        """Forget a vehicle's collision, and take what it touches now as no new one."""
        vehicle.collision = CollisionInfo()
        self._touched[vehicle.name] = _ANYTHING

    def note(self, event: VehicleEvent) -> None:
        """Take notice of what a vehicle's node tells."""
        vehicle = self._server.vehicles.get(event.source)
        if isinstance(event, Collision) and isinstance(vehicle, ServedMultirotor):
            self._take(vehicle, [c for c in vehicle.physics.contacts() if c.other == event.other])

    def watch(self) -> None:
        """Look what the vehicles touch; to be called 50 times a second."""
        for vehicle in self._server.vehicles.values():
            if not isinstance(vehicle, ServedMultirotor):
                continue
            vehicle.state()
            contacts = vehicle.physics.contacts() if vehicle.physics.touching() else []
            before = self._touched.get(vehicle.name, _ANYTHING)
            aged = {name: looks + 1 for name, looks in before.items() if looks < APART}
            self._touched[vehicle.name] = aged | {each.other: 0 for each in contacts}
            new = [each for each in contacts if each.other not in before]
            if new and "" not in before:
                self._take(vehicle, new)

    def _take(self, vehicle: ServedMultirotor, contacts: list[Contact]) -> None:
        """Keep the deepest of some contacts as a collision."""
        contact = max(contacts, key=lambda each: each.depth)
        other = self._server.objects.name_of(contact.other)
        vehicle.collision = CollisionInfo(
            True,
            contact.depth,
            vehicle.stamp,
            Vector3r(*contact.normal),
            vehicle.local(contact.position),
            vehicle.local(vehicle.state().position),
            other,
            self._server.segmentation.id_of(other),
        )
