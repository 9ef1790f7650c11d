"""RoboScape: spatial-temporal blocks in two branches, with projections from depth to RGB (paper §2.3)."""
