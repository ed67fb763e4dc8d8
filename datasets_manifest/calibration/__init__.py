"""The rig's calibration in the files of other programs."""
