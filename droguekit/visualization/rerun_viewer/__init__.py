"""Pairs, poses and errors as a recording of the rerun viewer."""
