"""Channels: the delivery of events between nodes, and the answers owed for them."""
