"""Tools round the core: the command line, checks of a file, the monitor, traces and sweeps.

They import the core; the core imports none of them.
"""
