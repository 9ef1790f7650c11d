"""Stores clips on disk and loads them for training: the ArrayRecord store and the Grain loader."""
