"""Traces of each node's steps, in real time and on the run's clock, for ui.perfetto.dev.

`record` notes steps and events on the loop, keeps the notes in a file, and finds which event led to
which; `write` makes the trace when the run is over, and reads one.
"""
