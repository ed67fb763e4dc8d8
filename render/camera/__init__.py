"""The camera: exposure, lens and sensor."""
