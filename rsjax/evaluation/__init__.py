"""Scores of generated clips: pixels, depth, controllability, and the intervals around their means."""
