"""What a stereo pair costs here and by plain scripts around Cycles and Mitsuba, at the same noise on the drogue."""
