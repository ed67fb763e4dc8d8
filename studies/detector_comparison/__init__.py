"""Our detectors beside those of other projects: same corpus, same image passes, same input, timed in turns."""
