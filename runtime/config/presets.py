"""Presets: tables of settings by name, which a table of the file takes and overrides key by key.

    imu = "bmi088"                                      # all of a preset
    imu = { preset = "bmi088", g_sensitivity = 0.0 }    # all but one setting

A settings class offers them by a field ``preset``, whose type holds them::

    class ImuParameters(...):
        preset: Annotated[str | None, msgspec.Meta(extra={"presets": IMUS})] = None

Beside ``"presets"``, ``"needed": {"width": "intrinsics"}`` says that who overrides a preset's width
has to override its intrinsics, if it has any.

They are put in where a file is read. The settings hold all figures then, and no `preset`, so that a
run repeats from them where a later version changes it.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, get_origin

import msgspec

from runtime.config.messages import show, struct_in, types_of
from runtime.errors import ConfigError, expect_known

Presets = Mapping[str, Mapping[str, Any]]


def presets_in(extra: Mapping[str, Any] | None) -> Presets:
    """Return the presets in the `extra` of a type's `Meta`."""
    found: Presets = (extra or {}).get("presets", {})
    return found


def by_name_alone(table: type[msgspec.Struct]) -> list[str]:
    """Return the presets whose name may stand in the place of the whole table."""
    required = any(field.required for field in msgspec.structs.fields(table))
    return [] if required else [*presets_in(_extra(table))]


def expanded(value: Any, type_: Any, where: str, at: str = "") -> Any:
    """Return settings of the file with their presets put in, at any depth.

    Raises:
        ConfigError: There is no such preset, or a setting is overridden without one it belongs to.
    """
    table = None if get_origin(type_) is dict else struct_in(type_)
    if table is None:
        return value
    if isinstance(value, list):
        return [expanded(each, table, where, f"{at}[{i}]") for i, each in enumerate(value)]
    extra = _extra(table)
    if isinstance(value, str) and extra:
        value = {"preset": value}
    if not isinstance(value, Mapping):
        return value
    if isinstance(value.get("preset"), str) and extra:
        value = _put_in(value, extra, f"{where}: {f'{at}.preset'[1:]}")
    types = types_of(table)
    return {k: expanded(v, types.get(k), where, f"{at}.{k}") for k, v in value.items()}


def _put_in(value: Mapping[str, Any], extra: Mapping[str, Any], where: str) -> dict[str, Any]:
    presets, name = presets_in(extra), value["preset"]
    listed = ", ".join(presets)
    expect_known(name, presets, f"{where}: expected one of {listed}, found {show(name)}")
    preset = presets[name]
    for key, other in extra.get("needed", {}).items():
        changed = key in value and value[key] != preset.get(key)
        if changed and other in preset and other not in value:
            raise ConfigError(
                f"{where}: expected {other} beside {key}, since that of {name} belongs to its own "
                f"{key}, found none"
            )
    return _merged(preset, {key: each for key, each in value.items() if key != "preset"})


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = {**below, **above}
    for key in below.keys() & above.keys():
        old, new = below[key], above[key]
        if isinstance(old, Mapping) and isinstance(new, Mapping) and "preset" not in new:
            both[key] = _merged(old, new)
    return both


@functools.cache
def _extra(table: type[msgspec.Struct]) -> Mapping[str, Any]:
    """Return what the type of a settings class's field ``preset`` holds; nothing without one."""
    marks = getattr(types_of(table).get("preset"), "__metadata__", ())
    return next((mark.extra for mark in marks if presets_in(mark.extra)), {})
