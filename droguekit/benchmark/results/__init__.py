"""The types of benchmark.json and of the detector benchmark's file."""
