"""Delay, loss and stamps of images: a function of seed, camera and time of exposure."""

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


def stamp_error(spec: CameraSpec, seed: int, stamp_ns: int) -> int:
    """Return the nanoseconds by which the stamps of an exposure are late.

    Args:
        spec: The camera.
        seed: Seed of the rig.
        stamp_ns: True time of the exposure.
    """
    random = generator(seed, f"{spec.name}/stamp", stamp_ns)
    error = float(spec.time_jitter) * random.uniform(-1.0, 1.0) if spec.time_jitter else 0.0
    return round((float(spec.time_offset) + error) * 1e9)
