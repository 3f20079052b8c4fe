"""A mesh file as a world, looked at before anybody flies in it."""
