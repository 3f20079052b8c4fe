"""The monitor: observation and control of a live run from outside.

`protocol` is the plain data that it exchanges with a run, and a client. `observer` makes snapshots
and carries commands out; `estimators` follows what is measured. `server` is in the run; `screen`
and `web` show a snapshot. Nothing here costs a run anything while nobody looks.
"""
