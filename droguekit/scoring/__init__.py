"""Compares estimates with the truth: scores, figures, reports. It knows estimators only by the files they wrote."""
