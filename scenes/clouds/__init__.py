"""Cloud layers as densities, rendered by ray marching."""
