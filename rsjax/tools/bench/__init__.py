"""Benchmarks of a configuration on this machine: medians of timed runs after warm-up, on synthetic inputs."""
