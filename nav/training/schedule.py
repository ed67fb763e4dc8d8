"""The learning rate over a training: a linear warm-up, then half a cosine."""

from __future__ import annotations

from math import cos, pi

from nav.training.training_settings import TrainingSettings


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """The learning rate of a step, counted from 0."""
    warmup = min(settings.warmup_passes // settings.batch_images, settings.steps // 2)
    if step < warmup:
        return settings.learning_rate * (step + 1) / (warmup + 1)
    done = (step - warmup) / max(settings.steps - warmup, 1)
    floor = settings.floor_fraction
    return settings.learning_rate * (floor + (1 - floor) * (1 + cos(pi * done)) / 2)
