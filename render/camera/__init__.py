"""The camera: lens, scattered light, sensor."""
