"""Flights flown once and used by many runs: the events of simulators and pilots.

`recorder` tells which nodes of a file fly, and notes what they do while they are flown; `player` is
what is kept of a flight, and has stand-ins send it again, at the same times and in the same order;
`cache` keeps flights by their content.
"""
