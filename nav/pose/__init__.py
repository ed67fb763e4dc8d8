"""From matched features to a pose: one interface, many methods."""
