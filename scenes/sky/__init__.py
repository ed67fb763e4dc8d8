"""The clear sky at any hour, its sources of light, and the air."""
