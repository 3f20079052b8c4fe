"""``python -m runtime``: see `runtime.tools.cli`."""

import sys

if __name__ == "__main__":
    try:
        from runtime.tools.cli import program

        program()
    except KeyboardInterrupt:  # importing takes a moment
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
