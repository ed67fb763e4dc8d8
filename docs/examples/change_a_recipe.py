"""Change a shipped recipe in Python, and see what the changes do to the same frame."""

from __future__ import annotations

import cv2
import numpy as np

import droguekit

plain = droguekit.load_recipe("smoke")
near_and_grey = droguekit.load_recipe(
    "smoke",
    rig={"preset": "mono", "width_px": 320, "height_px": 240, "focal_px": 533.0},
    distance={"law": "uniform", "low_m": 2.5, "high_m": 3.5},
    frames={"count": 4, "empty_fraction": 0.0},
)
for name, recipe in (("plain", plain), ("near-and-grey", near_and_grey)):
    pair = droguekit.render_pair(recipe, frame=1)
    image = pair.left if pair.left.ndim == 2 else cv2.cvtColor(pair.left, cv2.COLOR_RGB2BGR)
    cv2.imwrite(f"{name}.png", image)
    distance_m = "no drogue" if pair.truth is None else f"{np.linalg.norm(pair.truth.translation_m):.2f} m"
    print(f"{name}: {pair.left.shape}, {distance_m}")
