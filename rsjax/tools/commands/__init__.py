"""The commands, ``rsjax NAME``: each one parses its arguments and calls the library."""
