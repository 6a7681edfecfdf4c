"""From a system to its motion: prepare once, simulate, and what follows from a trajectory."""
