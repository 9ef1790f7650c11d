"""What is computed from recordings: shots, motion, depth, keypoint tracks and semantics."""
