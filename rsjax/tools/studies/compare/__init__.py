"""Puts evaluations of several runs side by side: seeds, paired intervals, tests, published numbers, film strips."""
