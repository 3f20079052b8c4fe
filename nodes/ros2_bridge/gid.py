"""The 16 bytes by which ROS tells one publisher from another."""

from __future__ import annotations

import xxhash


def gid(token: str) -> bytes:
    """Return the GID of the owner of a liveliness token, as rmw_zenoh_cpp makes it.

    It is the token's XXH3 hash of 128 bits, its low 64 bits first, little endian.
    """
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
