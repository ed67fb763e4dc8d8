"""What dataset to make: the sections of a recipe's TOML, checked."""
