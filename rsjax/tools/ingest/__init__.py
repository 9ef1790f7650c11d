"""What videos do not say of themselves: shots, motion, depth, tracks and semantics, and the clips cut by them."""
