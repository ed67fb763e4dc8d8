"""Trackers, which follow the drogue's box from pair to pair without the detector."""
