"""Render one stereo pair and plot the left image with the drogue's mask and the true centre of every marker."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

import droguekit

recipe = droguekit.load_recipe(
    "smoke", distance={"law": "stations", "stations_m": [3.0]}, frames={"empty_fraction": 0.0}
)
pair = droguekit.render_pair(recipe, frame=0)
print("the drogue is at", pair.truth.translation_m.round(3), "m in the left camera")

figure, (photo, depth) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
photo.imshow(pair.left)
photo.contour(pair.masks["left"], levels=[0.5], colors="white", linewidths=0.8)
centers = np.array([marker.center_proj_px for marker in pair.record.views.left.markers])
photo.plot(*centers.T, "c+", markersize=8)
photo.set_title("left image, mask and markers")
shown = depth.imshow(np.where(pair.masks["left"], pair.depth_m["left"], np.nan))
depth.set_title("depth of the drogue [m]")
figure.colorbar(shown, ax=depth)
figure.savefig("pair.png", dpi=120)
