"""A detector of generated video."""
