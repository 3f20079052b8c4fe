"""Calibrations in the formats of other programs, lint rules for rigs, and the self-test.

`formats` writes what was announced as the files of other programs, with a recording's data;
`readers` reads those files without knowing how they were written. `rules` says what is odd about a
rig before it flies (``lint``), and `command` flies it in the `room` and measures (``selftest``).
"""
