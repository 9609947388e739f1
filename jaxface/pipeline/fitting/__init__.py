"""Photo -> fitted face -> files."""
