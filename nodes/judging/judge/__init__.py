"""Evaluation of trajectories from outside a run, with a run's figures and report."""
