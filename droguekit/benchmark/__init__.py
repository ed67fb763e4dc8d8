"""Estimates against the truth: numbers, plots, report. Knows estimators only by what they wrote to disk."""
