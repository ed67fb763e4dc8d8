"""Motion from the poses of single pairs: a filter for pairs as they arrive, a smoother for finished sequences."""
