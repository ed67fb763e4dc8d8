"""`python -m tests.support.compiled_kernels`: compiles the loops that numba keeps on disk, before tests start.

Processes of the tests that start side by side would each compile the same loops, which takes a minute of each.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from datasets_manifest.storage.blind import BlindDataset
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from nav.realtime import warm_up_jit
from nav.runner import navigate

# Their first pairs need nearly all loops: skies with clouds, land, a hose that swings, raw and processed images.
_RECIPES = {
    "detector-train": {"rig": {"width_px": 320, "height_px": 240, "focal_px": 533.0}},
    "docking-10m": {"render": {"engine": "analytic"}},
    "cloud": {},
}


def main() -> None:
    """Navigate on the first pair of each recipe; where that is not possible, tests will tell why."""
    warm_up_jit()
    with tempfile.TemporaryDirectory(prefix="kernels-") as folder:
        for name, changes in _RECIPES.items():
            dataset = Path(folder) / name
            try:
                list(render_dataset(load_recipe(name, **changes), dataset, frames=range(1), workers=0))
                list(navigate(BlindDataset(dataset), ["joint"]))
            except (ValueError, OSError, ImportError) as error:
                print(f"kernels: {name}: {error}")


if __name__ == "__main__":
    main()
