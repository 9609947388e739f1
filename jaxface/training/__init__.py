"""Training loops: each network's in one file, read from top to bottom."""
