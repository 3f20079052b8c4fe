"""What this runtime is measured beside: one module a system, each with a `SYSTEMS` tuple.

A module must import without its system being installed; `System.missing` says what is. Nothing here
is needed to use the project.
"""
