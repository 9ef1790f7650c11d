"""A server of a world model for programs on other machines, and its client."""
