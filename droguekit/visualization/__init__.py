"""Pictures of datasets and results for people to look at."""
