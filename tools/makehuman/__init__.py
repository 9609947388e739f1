"""Build the bundled ``makehuman`` morphable model from CC0 MakeHuman data."""
