"""Path tracing with Mitsuba 3: own rays, only the pixels that something covers, the rest straight from the sky."""
