"""Grids of runs: some fields of a configuration varied, every combination with several seeds, and one table."""
