"""Imports public checkpoints and exports weights under public names. ``rsjax convert --help``"""

from rsjax.runtime import answer_while_importing

answer_while_importing()
