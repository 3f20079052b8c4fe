"""Systems outside the process: programs, and the native interface for them."""
