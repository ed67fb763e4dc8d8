"""The accuracy bars: what navigation must reach, what it reaches, and whether that is enough."""
