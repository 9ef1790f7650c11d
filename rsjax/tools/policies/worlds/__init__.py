"""Worlds in which policies act: the simulator and world models."""
