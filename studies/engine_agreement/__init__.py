"""Agreement of two render engines: the same frames by both, before the sensor, and their differences."""
