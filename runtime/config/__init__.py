"""The configuration file: its typed settings (`model`), how it is read and overridden."""
