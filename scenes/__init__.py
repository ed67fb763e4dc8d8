"""Functions from a recipe to frames: sky, cloud, light, ground, distance, attitude, framing."""
