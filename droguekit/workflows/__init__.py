"""What the commands do; the only package that combines generation, navigation and benchmark."""
