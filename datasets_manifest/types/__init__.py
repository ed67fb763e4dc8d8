"""Data types that packages share or store: frames, images, records, estimates."""
