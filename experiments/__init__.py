"""Commands: ``python -m experiments.<name>``. Each parses its arguments and calls the library."""
