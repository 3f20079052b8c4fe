"""Study of whether the simulator ranks systems as published figures of real data do.

    study.toml, rig.toml  →  `study`: a job for each sequence, world, condition, seed and system
                          →  `runtime.tools.sweep`  →  `results`: the ledger, a CSV of all runs
    published.toml        →  `agreement`: rankings, levels, failures  →  `page`: REALITY.md

Motions are those of EuRoC's published ground truth, given by a folder and never part of the
project. The command is ``python -m runtime reality``.
"""
