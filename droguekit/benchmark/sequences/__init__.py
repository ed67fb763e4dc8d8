"""What is only defined over sequences: motion, docking, latency, tracking."""
