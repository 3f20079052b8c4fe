"""The console command ``visnav``: the same as ``python -m runtime``.

It stands outside the packages, so that it can tell when `runtime` is another project's.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path


def main() -> None:
    """Run the command line, if the packages found are those installed together with this file."""
    try:
        _check_runtime()
        from runtime.tools.cli import program
    except KeyboardInterrupt:  # importing takes a moment
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    program()


def _check_runtime() -> None:
    """Raise ImportError if the package `runtime` is not the one beside this file."""
    expected = Path(__file__).resolve().parent / "runtime"
    spec = importlib.util.find_spec("runtime")
    found = Path(spec.origin).resolve() if spec is not None and spec.origin else None
    if found != expected / "__init__.py":
        raise ImportError(
            f"expected the package runtime in {expected}, found {found or 'none'}: "
            "another package of this name stands in the way"
        )
    if not (expected / "node.py").is_file():
        raise ImportError(
            f"expected the package runtime of visnav-runtime in {expected}, found another one "
            "installed over it: remove that one and install visnav-runtime again"
        )
