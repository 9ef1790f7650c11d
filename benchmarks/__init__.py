"""Benchmarks outside the package: rivals in PyTorch, the soak test, the playground."""
