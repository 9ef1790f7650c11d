"""The stages by real networks: torch and transformers are imported by the first call, weights are local files alone."""
