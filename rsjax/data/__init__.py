"""Clips on disk and on their way into training: the ArrayRecord store and the Grain loader."""
