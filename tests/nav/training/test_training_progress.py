from __future__ import annotations

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nav.training.training_progress import TENSORBOARD_FOLDER, TensorBoardCurves


def test_a_resumed_training_keeps_the_points_up_to_its_checkpoint(tmp_path: Path) -> None:
    """Those behind it belong to steps that are done again."""
    for start, points in ((0, (400, 800, 1200)), (800, (1200, 1600))):
        curves = TensorBoardCurves(tmp_path, start)
        for image_passes in points:
            curves.add_step(image_passes, float(start), 0.0, 0.0, 0.0)
        curves.close()
    read = EventAccumulator(str(tmp_path / TENSORBOARD_FOLDER))
    read.Reload()
    assert [(each.step, each.value) for each in read.Scalars("train/loss")] == [
        (400, 0.0),
        (800, 0.0),
        (1200, 800.0),
        (1600, 800.0),
    ]
