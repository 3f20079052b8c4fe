"""A run: starting, watching and ending its nodes, and its results."""
