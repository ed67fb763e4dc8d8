"""How many scenes of a recipe look different: clusters of their surroundings, as pictures without drogue and tanker."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.images import srgb_from_light
from scenes.environment_radiance import EnvironmentRadiance
from scenes.environment_sampling import environment_of_scene
from scenes.sampler import recipe_of_scene
from scenes.sky.photometry import luminance

Picture = NDArray[np.float32]

WIDTH_PX, HEIGHT_PX = 96, 72
# The view of the ideal rigs, level and along the flight.
_FOCAL_PX = WIDTH_PX / 1280 * 2133.333
# The meter brings the mean luminance to this share of white, as automatic exposures of cameras do (ISO 12232).
_MEAN_LEVEL = 0.18
# Blocks across and down whose colours and contrasts make up a look.
_COLUMNS, _ROWS = 4, 6
ALIKE_DELTA_E = 3.0
"""Scenes whose looks differ by less are one cluster; the root mean square over blocks, in units of CIELAB."""
LEAST_SHARE = 0.8
"""Clusters of a family over its scenes, at least."""


class FamilyVariety(NamedTuple):
    """Clusters of one family.

    Attributes:
        family: its name.
        scenes: number of its scenes.
        clusters: number of clusters that hold a scene of it.
    """

    family: str
    scenes: int
    clusters: int


def surroundings_picture(environment: Environment) -> Picture:
    """(72, 96, 3) sky and ground ahead, as a camera shows them that exposes for their mean: sRGB from 0 to 1."""
    u, v = np.meshgrid(np.arange(WIDTH_PX) - WIDTH_PX / 2 + 0.5, np.arange(HEIGHT_PX) - HEIGHT_PX / 2 + 0.5)
    rays = np.stack([np.full_like(u, _FOCAL_PX), -u, -v], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    around = EnvironmentRadiance(environment)
    light = around.radiance(rays)
    # The sun's disc is left out, and half of the meter's weight is the median's, as meters weigh what does not clip.
    metered = float(np.median(luminance(light)) + luminance(light).mean()) / 2
    around.add_discs(light, rays)
    picture: Picture = srgb_from_light(np.clip(light * (_MEAN_LEVEL / metered), 0.0, 1.0)).astype(np.float32)
    return picture


def look(picture: Picture) -> NDArray[np.float64]:
    """(144,) look of a picture: CIELAB means of blocks, and standard deviations of their lightness and colours."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB).astype(np.float64)
    blocks = lab.reshape(_ROWS, HEIGHT_PX // _ROWS, _COLUMNS, WIDTH_PX // _COLUMNS, 3)
    values: NDArray[np.float64] = np.concatenate([blocks.mean(axis=(1, 3)), blocks.std(axis=(1, 3))], axis=-1)
    return values.ravel()


def clusters(looks: Sequence[NDArray[np.float64]], alike_delta_e: float = ALIKE_DELTA_E) -> NDArray[np.intp]:
    """(N,) cluster of each of N looks by single linkage: looks that are alike are in one, and so are chains of them."""
    if len(looks) == 1:
        return np.ones(1, dtype=np.intp)
    values = np.stack(looks)
    # Over blocks, so that one that differs wholly counts by its share of the picture.
    scaled = values / np.sqrt(_COLUMNS * _ROWS)
    found: NDArray[np.intp] = fcluster(linkage(scaled, "single"), alike_delta_e, "distance").astype(np.intp)
    return found


def family_variety(families: Sequence[str], cluster_of: Sequence[int] | NDArray[np.intp]) -> list[FamilyVariety]:
    """Clusters of each family, in the order of their names' first scenes."""
    scenes = Counter(families)
    return [
        FamilyVariety(name, count, len({int(c) for f, c in zip(families, cluster_of, strict=True) if f == name}))
        for name, count in scenes.items()
    ]


def variety_table(recipe: Recipe, only: Sequence[str] = ()) -> str:
    """Scenes and clusters of a recipe's families, as a table in Markdown.

    Args:
        recipe: whose scenes to compare.
        only: names of the families to compare; all if empty.

    Raises:
        ValueError: no scene is of these families.
    """
    names, looks = [], []
    for scene_id in range(recipe.frames.scenes):
        own = recipe_of_scene(recipe, scene_id)
        if only and own.family not in only:
            continue
        environment = environment_of_scene(recipe.stream_seed, scene_id, own.environment)
        names.append(own.family)
        looks.append(look(surroundings_picture(environment)))
    if not looks:
        raise ValueError(f"--family: recipe {recipe.name} has no scene of {', '.join(only)}")
    found = clusters(looks)
    rows = [f"| {recipe.name} | scenes | clusters | share |", "|---|---|---|---|"]
    for each in [*family_variety(names, found), FamilyVariety("all", len(looks), len(set(found.tolist())))]:
        share = each.clusters / each.scenes
        mark = "" if share >= LEAST_SHARE or each.family == "all" else ", too few"
        rows.append(f"| {each.family} | {each.scenes} | {each.clusters} | {100 * share:.0f} %{mark} |")
    return "\n".join(rows)
