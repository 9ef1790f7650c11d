"""The world model: spatial-temporal blocks in two branches, joined depth → RGB (paper §2.3)."""
