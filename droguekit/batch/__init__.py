"""Many frames: planning them, making them in worker processes, going on after a stop, making one again."""
