"""Hostile and absurd inputs for every border of the project, and kills at random moments of its long commands."""
