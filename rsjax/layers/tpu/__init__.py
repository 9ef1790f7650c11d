"""What TPUs need to be fast; :mod:`rsjax.layers.platform` decides where it is used."""
