"""Exports of datasets to the formats of other programs, one module for each."""
