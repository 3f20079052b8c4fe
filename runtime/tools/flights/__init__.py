"""Flights that are flown once and used by many runs: what simulators and pilots have sent.

`part` tells which nodes of a file fly, and whether anything else has an influence on them; `layout`
is what is kept of a flight; `recorder` notes it while it is flown, `player` has stand-ins send it
again, at the same times and in the same order; `cache` keeps flights by their content.
"""
