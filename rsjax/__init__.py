"""rsjax: a JAX/Flax implementation of RoboScape (arXiv 2506.23135), a physics-informed robot world model."""

__version__ = "0.1.0"
