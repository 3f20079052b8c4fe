"""Looking at a run from outside while it goes, and having a say in it.

`snapshot` is what there is to see and `command` what there is to say: plain data. `meter` and
`observer` make snapshots of a run, `timekeeping` and `perform` do what was asked. `server` is in
the run and `client` anywhere else, with `address` between them; `screen` and `web` show it.
Nothing here costs a run anything while nobody looks.
"""
