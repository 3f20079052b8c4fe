"""The monitor: shows a run from outside while it goes, and controls it.

`snapshot` and `command` are the plain data that it exchanges with a run. `meter` and `observer`
make snapshots and carry commands out; `images` makes JPEGs of what cameras send. `server` is in the
run and `client` anywhere else, with `address` between them; `screen` and `web` show it. Nothing
here costs a run anything while nobody looks.
"""
