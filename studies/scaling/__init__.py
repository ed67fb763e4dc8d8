"""Speed-up and overhead of rendering frames with several workers."""
