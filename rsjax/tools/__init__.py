"""What serves people around the core; the core imports none of it."""
