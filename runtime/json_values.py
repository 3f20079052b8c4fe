"""Values as JSON knows them."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np


def plain(value: Any, where: str) -> Any:
    """Return a value, numpy's too, in JSON types; raise `TypeError` if it has no form in JSON."""
    try:
        converted = msgspec.to_builtins(value, enc_hook=_without_numpy, str_keys=True)
        msgspec.json.encode(converted)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise TypeError(
            f"{where}: expected what JSON knows, found {value!r:.80}: {error}"
        ) from None
    return converted


def _without_numpy(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is none of it")
