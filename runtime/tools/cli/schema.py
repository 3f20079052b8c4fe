"""``schema``: what a file may hold, for editors that complete and check TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def schema(
    out: Annotated[
        Path | None, typer.Option(help="File to write; it is printed if not given.")
    ] = None,
) -> None:
    """Write the JSON schema of configuration files, from the types of all listed nodes.

    A file whose first line is "#:schema PATH" is then completed and checked by editors that know
    such schemas, for example with Taplo or Even Better TOML.
    """
    import json

    from runtime.config.reading import find_nodes
    from runtime.tools.cli.common import warn
    from runtime.tools.schema import schema as schema_of

    text = json.dumps(schema_of(find_nodes(warn)), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    out.write_text(text, encoding="utf-8")
    print(out)
