"""Systems to compare this runtime with: a module per system, each with a `SYSTEMS` tuple.

A module must import without its system being installed; `System.missing` says what is. `measure`
of a `System` sets up node 1, exchanges pings and tears down; where nodes have processes of their
own, `serve` of the module is one (see `children`). No wheel has this folder.
"""
