"""Whether two renderers agree: the same frames by both, before the sensor, and what differs."""
