"""The drogue as flat rings, with exact coverage of every pixel: no sampling, no shadows, no depth."""
