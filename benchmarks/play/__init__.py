"""How fast the playground answers."""
