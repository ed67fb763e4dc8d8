"""A dataset's descriptions for others: card, Croissant, provenance, published manifests."""
