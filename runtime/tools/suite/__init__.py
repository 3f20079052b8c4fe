"""Estimator suite: scenarios from easy to brutal, each flown once, results in a single table.

    suite.toml  →  `plan`: a job for each scenario, estimator and repeat  →  `runtime.tools.sweep`
                →  `page`: SUITE.md and its pictures

``rig.toml`` is the vehicle with its sensors; ``suite.toml`` says what changes in each scenario, and
which estimators there are. The command is ``python -m runtime suite``.
"""
