"""The seed paper's tables and figures, measured here, with its published numbers beside them."""
