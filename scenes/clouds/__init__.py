"""Cloud layers as densities through which rays are marched."""
