"""Fine-tunes a trained world model on recordings of another robot."""
