"""Estimates the drogue's pose from stereo images; knows images, rig and drogue, and nothing of how they were made."""
