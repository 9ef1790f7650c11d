"""Generation: first frame and actions in, the video that follows out."""
