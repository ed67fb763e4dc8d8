"""From a recipe to frames: sky, clouds, light, ground, distance, attitude and framing."""
