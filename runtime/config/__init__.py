"""Configuration file: its typed settings (`model`), reading and overriding."""
