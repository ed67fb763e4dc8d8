"""Parametric tankers in the frame whose origin is where the hose leaves."""
