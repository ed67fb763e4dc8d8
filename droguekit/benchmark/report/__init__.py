"""The benchmark as a page."""
