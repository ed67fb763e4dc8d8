"""Types of `benchmark.json` and of the files of the detector benchmark."""
