"""Rigid transforms, pinhole cameras, the stereo rig and the images of circles, with numpy and scipy only."""
