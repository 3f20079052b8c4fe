"""``export``: the data of a recording as text files."""
