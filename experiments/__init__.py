"""The commands, ``python -m experiments.<name>``: each one parses its arguments and calls the library."""

from rsjax.runtime import answer_while_importing

answer_while_importing()
