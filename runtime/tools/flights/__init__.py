"""Flights that are flown once and used by many runs: what simulators and pilots have sent.

`recorder` tells which nodes of a file fly, and notes what they do while they are flown; `player` is
what is kept of a flight, and has stand-ins send it again, at the same times and in the same order;
`cache` keeps flights by their content.
"""
