"""jaxface: differentiable optimisation of faces in JAX."""

__version__ = "0.1.0"
