"""Stereo calibrations in the files of other programs: writing and reading."""
