"""How much of its time a training waits for pairs that are rendered meanwhile."""
