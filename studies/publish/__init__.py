"""The published manifests, made anew."""
