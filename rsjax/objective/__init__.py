"""What the world model learns: masked tokens, depth, and keypoint dynamics (paper Eq. 4–8)."""
