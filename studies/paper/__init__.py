"""The seed paper's tables and figures, measured here and compared with its published numbers."""
