"""Training runs: data in, weights and a report out."""
