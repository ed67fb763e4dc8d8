"""From stereo images to the drogue's pose. Sees images, rig and drogue, and nothing of how they were made."""
