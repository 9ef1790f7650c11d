"""World models: their interface (:mod:`rsjax.models.base`), and one package per family.

A family's settings (``config.py``) load without JAX; its model is imported when one is created.
"""
