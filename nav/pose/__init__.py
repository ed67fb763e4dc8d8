"""Pose methods: from matched features to a pose, behind one interface."""
