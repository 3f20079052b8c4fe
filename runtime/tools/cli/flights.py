"""``flights``: what is kept of recorded flights."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

import typer


def flights(
    keep: Annotated[
        float | None,
        typer.Option(min=0, metavar="GB", help="Remove those not used for longest beyond this."),
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of them.")] = False,
) -> None:
    """Show the flights that sweeps have recorded, or remove some.

    A sweep flies once what several of its runs have in common, and keeps it for later ones: up to
    20 GB, or as many as VISNAV_FLIGHTS_GB says. What a flight depends on is a part of its name, so
    one that no longer fits is not used, and goes when it was not used for longest.
    """
    from runtime.tools.flights.cache import home, kept, remove_beyond

    if clear or keep is not None:
        removed = remove_beyond(0.0 if clear or keep is None else keep)
        gigabytes = sum(each.size for each in removed) / 1e9
        print(f"{len(removed)} flights removed, {gigabytes:.2f} GB")
    found = kept()
    for each in found:
        used = datetime.fromtimestamp(each.used).strftime("%Y-%m-%d %H:%M")
        print(f"{each.path.stem}  {each.size / 1e9:7.2f} GB  used {used}")
    print(f"{len(found)} flights, {sum(each.size for each in found) / 1e9:.2f} GB in {home()}")
