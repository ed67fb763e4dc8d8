"""What a dataset covers, and how two datasets differ."""
