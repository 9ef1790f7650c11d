"""Grids of runs: some fields of a configuration vary, every combination runs with several seeds, one table."""
