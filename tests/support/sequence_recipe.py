"""A short recipe of two sequences, in which a receiver keeps its station."""

from __future__ import annotations

from datasets_manifest.recipe.recipe import Recipe, parse_recipe

BASE = """
name = "sequence-test"
seed = 2
[frames]
count = 60
scenes = 2
[exposure]
time_s = 0.002
[sequence]
frames_per_sequence = 20
%s
[sequence.receiver]
manoeuvres = ["station"]
start_m = 4.0
%s
"""


def recipe(sequence: str = "", receiver: str = "", more: str = "") -> Recipe:
    """With these lines in the sections of the sequence and of its receiver, and more sections behind them."""
    return parse_recipe(BASE % (sequence, receiver) + more)
