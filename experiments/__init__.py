"""The commands as modules: ``python -m experiments.NAME`` is ``rsjax NAME``."""

from rsjax.runtime import answer_while_importing

answer_while_importing()
