"""Score an estimator of your own beside the bundled one.

The estimator here sees the left image's true marker centres with noise of 0.3 px and solves the perspective-n-point
problem: what a single camera can do with good centroids.
"""

from __future__ import annotations

import cv2
import numpy as np

import droguekit
from datasets_manifest.types.estimates import Estimate
from drogue_models.marker_layout import marker_layout
from geometry.se3 import RigidTransform


def estimate_from_left_image(pair: droguekit.StereoPair, random: np.random.Generator) -> Estimate:
    """A pose from one image."""
    centers_px = np.array([marker.center_proj_px for marker in pair.record.views.left.markers])
    if len(centers_px) == 0:
        return droguekit.NoFix(frame_index=pair.frame_index, method="left-only", reason="no marker is seen")
    noisy_px = centers_px + random.normal(0.0, 0.3, centers_px.shape)
    markers_m = marker_layout(pair.drogue).centers_m
    _, rotation, translation_m = cv2.solvePnP(
        markers_m, noisy_px, pair.rig.camera.matrix(), None, flags=cv2.SOLVEPNP_IPPE
    )
    pose = RigidTransform(cv2.Rodrigues(rotation)[0], translation_m.ravel())
    return droguekit.PoseEstimate(frame_index=pair.frame_index, method="left-only", left_from_drogue=pose)


def main() -> None:
    """Render, estimate and compare."""
    recipe = droguekit.load_recipe("smoke", frames={"count": 4, "scenes": 2, "empty_fraction": 0.0})
    pairs = droguekit.render_dataset(recipe, "own-estimator-pairs", workers=0)
    random = np.random.default_rng(1)
    navigator = droguekit.Navigator(pairs.rig, pairs.drogue)
    estimates = [estimate_from_left_image(pair, random) for pair in pairs]
    estimates += [navigator.estimate(pair.images, pair.frame_index) for pair in pairs]
    scores = droguekit.benchmark(pairs, estimates)
    table = scores.to_frame()
    overall = table[table["low_m"].isna()]
    print(overall[["method", "n", "fixes", "position_rmse_m", "pitch_rmse_deg"]].to_string(index=False))
    scores.plot("position").savefig("position-error.png", dpi=120)


if __name__ == "__main__":
    main()
