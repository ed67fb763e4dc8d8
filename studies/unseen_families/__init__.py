"""Whether a detector finds drogues of a family that it never saw."""
