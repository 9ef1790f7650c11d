"""Scores generated clips: pixels, depth, controllability, with confidence intervals."""
