"""Training: the state, one train step, its placement on devices, checkpoints, and the loop around them."""
