"""Path tracing with Mitsuba 3: only pixels that an object covers are traced; the others show the background."""
