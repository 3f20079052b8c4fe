"""What the viewers share: which images are shown, how they are encoded, and paths in pieces."""
