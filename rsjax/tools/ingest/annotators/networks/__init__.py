"""Annotators that run networks: torch and transformers are imported by the first call; weights are local files only."""
