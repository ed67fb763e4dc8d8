"""Acceptance criteria of navigation: the required accuracy, the measured one with its 95 % limit, and the verdict."""
