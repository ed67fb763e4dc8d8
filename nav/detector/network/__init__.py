"""The detector network in torch: what is trained and exported. Nothing that navigates imports it."""
