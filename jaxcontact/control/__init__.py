"""What a motion is asked for: costs, controls, and the problem that an optimiser sees."""
