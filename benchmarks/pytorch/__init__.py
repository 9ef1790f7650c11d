"""Plain PyTorch networks that the benchmark compares with."""
