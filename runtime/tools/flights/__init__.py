"""Flights flown once and used by many runs: the events of simulators and pilots.

`flight` records what the nodes of a flight do, and has stand-ins do it again, at the same times and
in the same order; `cache` tells which nodes of a file fly, and keeps flights by their content.
"""
