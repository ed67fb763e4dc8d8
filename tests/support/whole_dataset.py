"""The dataset that the fuzz tests damage."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.writer import write_calibration, write_frame
from droguekit.batch.frame_task import make_frame
from labelgen.export.annotations.coco import write_annotations
from render.engine import load_engine
from tests.support.recipe_builder import recipe_text, stations

RECIPE = recipe_text(
    name="fuzz",
    seed=5,
    rig={"preset": "rgb-ideal", "width_px": 48, "height_px": 36, "focal_px": 80.0},
    frames={"count": 3, "scenes": 2, "empty_fraction": 0.3},
    distance=stations(2.5),
    environment={"clouds": {"scene_fraction": 0.0}},
    render={"engine": "analytic"},
    outputs={"exr": True},
    split={"train": 0.5, "test": 0.5},
)


def write_whole_dataset(folder: Path) -> None:
    """Three tiny pairs with EXR files, and all that stands beside them."""
    recipe, engine = parse_recipe(RECIPE), load_engine("analytic")
    for index in range(recipe.frames.count):
        record, files, _ = make_frame(recipe, index, engine)
        write_frame(folder, record, files)
    splits = {scene_id: ("train", "test")[scene_id % 2] for scene_id in range(recipe.frames.scenes)}
    write_manifest(folder, build_manifest(folder, recipe, "1", splits))
    write_calibration(folder, recipe.rig)
    write_annotations(folder, folder / "annotations")
    (folder / "recipe.toml").write_text(RECIPE)
