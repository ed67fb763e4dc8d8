"""Finds markers among image regions: the marker channel, blobs, and the ring that they form."""
