"""Cost of a stereo pair by our renderer and by plain Cycles and Mitsuba scripts, at equal noise on the drogue."""
