"""Synthetic stereo data of a refuelling drogue with ground truth, and a navigation stack measured against it.

Names are loaded at their first use, so that `import droguekit` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datasets_manifest.types.estimates import NoFix, PoseEstimate
    from droguekit.api.method_benchmark import PoseScores, benchmark
    from droguekit.api.pose_navigator import Navigator
    from droguekit.api.recipe_rendering import load_recipe, render_dataset, render_pair
    from droguekit.api.stereo_dataset import StereoDataset, StereoPair, open_dataset

__all__ = [
    "Navigator",
    "NoFix",
    "PoseEstimate",
    "PoseScores",
    "StereoDataset",
    "StereoPair",
    "benchmark",
    "load_recipe",
    "open_dataset",
    "render_dataset",
    "render_pair",
]

_MODULES = {
    "Navigator": "droguekit.api.pose_navigator",
    "NoFix": "datasets_manifest.types.estimates",
    "PoseEstimate": "datasets_manifest.types.estimates",
    "PoseScores": "droguekit.api.method_benchmark",
    "StereoDataset": "droguekit.api.stereo_dataset",
    "StereoPair": "droguekit.api.stereo_dataset",
    "benchmark": "droguekit.api.method_benchmark",
    "load_recipe": "droguekit.api.recipe_rendering",
    "open_dataset": "droguekit.api.stereo_dataset",
    "render_dataset": "droguekit.api.recipe_rendering",
    "render_pair": "droguekit.api.recipe_rendering",
}


def __getattr__(name: str) -> Any:
    """The public object of that name.

    Raises:
        AttributeError: there is none.
    """
    if name not in _MODULES:
        raise AttributeError(f"module 'droguekit' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names."""
    return sorted({*globals(), *__all__})
