"""Our detectors beside those of ultralytics: same corpus, same image passes, same input, timed in turns."""
