"""What notices that an event loop is blocked, or that a run makes no progress."""
