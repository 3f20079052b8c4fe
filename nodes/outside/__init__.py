"""Systems outside the process: programs, and the native interface that they speak."""
