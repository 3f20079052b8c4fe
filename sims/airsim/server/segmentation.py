"""Segmentation IDs: which number, and so which colour, each object has in images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sims.airsim.server.methods import rpc
from sims.airsim.server.regex import whole_matches

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

HIDDEN = -1
"""ID of an object that is left out of segmentation images: it is black there, as nothing is."""


def initial_id(name: str) -> int:
    """Return AirSim's first ID of an object: of its lower-cased name 5 and all codes from 97."""
    return (5 + sum(code for code in map(ord, name.lower()) if code >= 97)) % 256


class Segmentation:
    """The IDs of all objects, and the methods that read and change them."""

    def __init__(self, server: AirsimServer) -> None:
        self._objects: Mapping[str, tuple[int, ...]] = server.objects.geoms
        self._ids = np.full(server.world.model.ngeom + 1, HIDDEN)
        for name in sorted(self._objects, key=lambda each: -len(self._objects[each])):
            self._set(name, initial_id(name))  # that of a part goes before that of the whole

    def added(self, name: str) -> None:
        """Give an object that has come into the world its first ID."""
        self._set(name, initial_id(name))

    def ids(self) -> npt.NDArray[np.uint8]:
        """Return the ID of each geom as it is drawn, and last that of nothing, shape (n + 1,)."""
        return np.maximum(self._ids, 0).astype(np.uint8)

    @rpc("simGetSegmentationObjectID")
    def id_of(self, name: str) -> int:
        """Return the ID of an object, whatever the case of its name; -1 if there is none."""
        known = {each.lower(): geoms for each, geoms in self._objects.items()}
        geoms = known.get(name.lower())
        return int(self._ids[geoms[0]]) if geoms else HIDDEN

    @rpc("simSetSegmentationObjectID")
    def set_id(self, name: str, object_id: int, is_regex: bool = False) -> bool:
        """Set the ID (at most 255) of the objects of a name; -1 leaves them out, in black."""
        if is_regex:
            found = whole_matches(name, self._objects, ignore_case=True)
        else:
            found = [name] if name in self._objects else []
        for each in found:
            self._set(each, min(max(object_id, HIDDEN), 255))
        return bool(found)

    def _set(self, name: str, object_id: int) -> None:
        self._ids[list(self._objects[name])] = object_id
