"""``recover``: a torn recording made whole."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def recover(
    file: Annotated[Path, typer.Argument(help="A recording: runs/<name>/recording.mcap.")],
    out: Annotated[
        Path | None,
        typer.Option(help="A new file to write; if not given, the whole file replaces the torn."),
    ] = None,
) -> None:
    """Mend the recording of a run that was killed, or whose disk was full.

    What can be read is written to a complete file with an index. Such a run has at most its last
    second missing. A file that has its index is only looked through.
    """
    from nodes.data.recorder.recover import recover_file
    from runtime.errors import ConfigError

    try:
        done = recover_file(file, out)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    for trouble in done.trouble:
        print(f"{file}: {trouble}")
    partial = "; what is named above is missing" if done.partial else ""
    if done.mended:
        print(f"{done.path}: {done.messages} messages, now with an index{partial}")
    elif done.partial:
        print(f"{done.path}: {done.messages} messages, has its index, left as it is{partial}")
    else:
        print(f"{done.path}: {done.messages} messages, complete, nothing to mend")
