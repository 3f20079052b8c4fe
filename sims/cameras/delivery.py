"""Delay and loss of images: a function of seed, camera and stamp."""

from __future__ import annotations

from sims.cameras.noise import generator
from sims.cameras.spec import CameraSpec


def delay_of(spec: CameraSpec, seed: int, stamp_ns: int) -> float | None:
    """Return the seconds from an exposure to its delivery, or None if it is lost.

    Args:
        spec: The camera.
        seed: Seed of the rig.
        stamp_ns: Stamp of the exposure.
    """
    # No camera's name has a slash: what is drawn here and the noise are independent.
    random = generator(seed, f"{spec.name}/delivery", stamp_ns)
    if random.random() < spec.loss:
        return None
    return float(spec.latency) + float(spec.jitter) * random.random()
