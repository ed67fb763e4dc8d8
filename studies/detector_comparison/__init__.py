"""Our detectors beside YOLOv8 of ultralytics: same corpus, same image passes, same input, timed in turns."""
