"""Sums of norms of convex combinations, minimised with a certified gap."""

from jaxface.solvers.simplex._minimise_on_simplex import minimise_on_simplex

__all__ = ["minimise_on_simplex"]
