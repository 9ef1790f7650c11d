"""Training: the state, one train step, its sharding over devices, checkpoints, and the loop around them."""
