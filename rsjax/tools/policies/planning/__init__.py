"""Planning in a world model, and trying the plans in the simulator."""
