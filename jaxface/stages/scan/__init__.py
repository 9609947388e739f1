"""A head scan into a model's topology and UVs."""
