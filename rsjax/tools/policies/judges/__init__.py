"""Judges of success, and their training and validation."""
