"""Descriptions of a dataset for publication: card, Croissant metadata, published manifests."""
