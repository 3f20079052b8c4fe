"""Traces: what each node did when, in real time and in the run's own, for ui.perfetto.dev.

`record` is on the loop and does next to nothing; `spool` keeps what it notes in a file; `causes`
says which event led to which; `write` makes the trace of it when the run is over; `paths` reads
a trace and tells how long sensors take to become set-points.
"""
