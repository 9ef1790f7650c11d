"""Imports public checkpoints and exports weights under public names. ``python -m rsjax.convert --help``"""
