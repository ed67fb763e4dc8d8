"""Renders the published datasets again and writes their manifests."""
