"""Grids of runs: some fields of a configuration vary, each combination runs with several seeds, and a table results."""
