"""How fast a configuration runs on this machine: medians of timed runs after warm-up, on synthetic inputs."""
