"""Rigid transforms, pinhole cameras, the stereo rig, the images of circles, and samples between pixels."""
