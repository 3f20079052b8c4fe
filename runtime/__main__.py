"""``python -m runtime``: see `runtime.tools.cli`."""

import signal
import sys

if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # see `runtime`
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        from runtime.tools.cli import program

        program()
    except KeyboardInterrupt:  # importing takes a moment
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
