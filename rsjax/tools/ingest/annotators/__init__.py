"""Annotators, which compute shots, motion, depth, keypoint tracks and semantics from recordings."""
