"""The same pairs by two variants of Mitsuba: whether they agree within noise, and how many each makes a second."""
