"""Motion in a sequence: hose, turbulence, receiver, and what hides the drogue."""
