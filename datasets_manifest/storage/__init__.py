"""The disk: where files lie, how they appear whole, how they are read."""
