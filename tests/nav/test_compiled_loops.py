"""When the stack's compiled loops are compiled, and where they are cached."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from nav.centroids import blurred_edges, centroid_uncertainty, outline_pixels
from nav.matching import ring_matching
from nav.numerics import cholesky, levenberg_marquardt
from nav.pose import adjustment_loops, tilt_pairs
from nav.tracking import pose_predict


def test_what_is_fitted_before_pairs_come_leaves_next_to_nothing_to_compile() -> None:
    code = """
from datasets_manifest.recipe.recipe import load_recipe
from nav.centroids import blurred_edges, centroid_uncertainty, outline_pixels
from nav.matching import ring_matching
from nav.numerics import cholesky, levenberg_marquardt
from nav.tracking import pose_predict
from nav.realtime import warm_up_jit
from nav.pair_navigator import PairNavigator
from nav.pose import adjustment_loops, tilt_pairs
from render.engine import load_engine
from render.camera.sensor import expose
from scenes.sampler import sample_frame

def compiled():
    loops = (adjustment_loops, blurred_edges, centroid_uncertainty, cholesky, levenberg_marquardt, outline_pixels,
             pose_predict,
             ring_matching, tilt_pairs)
    return {(name, kind) for room in loops for name, loop in vars(room).items()
            for kind in map(str, getattr(loop, "signatures", ()))}

warm_up_jit()
before = compiled()
recipe = load_recipe("pose-tier-a").recipe
for index in (1, 4):
    frame = sample_frame(recipe, index)
    images = expose(frame, load_engine("analytic").render(frame, recipe.render))
    (estimate,) = PairNavigator(recipe.rig, recipe.drogue).estimate(index, images, ["joint-hub"])
    assert estimate.status == "fix"
assert "_best_shift" in {name for name, _ in before}
print(len(before), *sorted({name for name, _ in compiled() - before}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    count, *later = done.stdout.split()
    assert int(count) > 10
    # Images may be of another kind of numbers than what was fitted.
    assert set(later) <= {"take_cells"}


@pytest.mark.parametrize(
    "loops",
    [
        adjustment_loops,
        blurred_edges,
        centroid_uncertainty,
        cholesky,
        levenberg_marquardt,
        outline_pixels,
        pose_predict,
        ring_matching,
        tilt_pairs,
    ],
)
def test_loops_can_be_cached_beside_their_file_or_at_home(loops: Any) -> None:
    found = [loop for loop in vars(loops).values() if hasattr(loop, "signatures")]
    assert found and all(loop.stats.cache_path for loop in found)
