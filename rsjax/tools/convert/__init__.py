"""Imports public checkpoints and exports weights under public names. ``python -m experiments.convert --help``"""

from rsjax.runtime import answer_while_importing

answer_while_importing()
