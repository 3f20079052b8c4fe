"""``python -m runtime``: see `runtime.tools.cli`."""

import sys

if __name__ == "__main__":
    try:
        from runtime.extras import check_events

        check_events()
        from runtime.tools.cli import program

        program()
    except KeyboardInterrupt:  # importing takes a moment
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except ImportError as error:
        if error.name != "runtime":  # not what `check_events` says
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
