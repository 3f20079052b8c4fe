"""A Zenoh router in a process of its own: what rmw_zenohd is.

python router.py PORT
"""

from __future__ import annotations

import json
import sys
import time

import zenoh


def main() -> None:
    configuration = zenoh.Config()
    configuration.insert_json5("mode", '"router"')
    configuration.insert_json5("scouting/multicast/enabled", "false")
    configuration.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{sys.argv[1]}"]))
    with zenoh.open(configuration):
        print("ready", flush=True)
        time.sleep(120)  # to be killed before


if __name__ == "__main__":
    main()
