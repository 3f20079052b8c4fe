"""Trajectories that somebody else computed, judged as a run judges its estimators."""
