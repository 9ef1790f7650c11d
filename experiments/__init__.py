"""Commands: ``python -m experiments.<name>``. Each parses its arguments and calls the library."""

from rsjax.runtime import answer_while_importing

answer_while_importing()
