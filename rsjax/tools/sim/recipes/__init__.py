"""What the training episodes of Lift show, by name."""
