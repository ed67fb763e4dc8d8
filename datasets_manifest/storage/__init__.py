"""Datasets on disk or in object stores: layout, atomic writing, reading."""
