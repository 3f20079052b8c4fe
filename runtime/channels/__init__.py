"""Channels: how an event gets from node to node, and what it is owed for it."""
