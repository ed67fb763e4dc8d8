"""The dataset's card: contents, origin, purpose and limits in words, with Hugging Face's metadata."""

from __future__ import annotations

import json
from typing import Any

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.storage.layout import CARD_FILE
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.storage import Location, join, open_storage

# https://github.com/huggingface/hub-docs/blob/main/datasetcard.md: steps of the tag `size_categories`, by images.
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_LARGEST = "n>1M"
_TAGS = ("aerial-refuelling", "drogue", "stereo", "6d-pose", "synthetic")
_PLAIN = {ord("<"): "&lt;", ord("`"): "'", ord("["): "\\["}
_LIMITS = """\
* Every image is computed. What the model leaves out, such as rain, ice, heat haze of engines and cloth that flutters,
  is missing, and results on these images do not prove results with a real camera.
* Dimensions that the seed paper does not give (marker circle, hub, canopy, hose, tanker) are our choice; the manifest
  holds all of them.
* Equal, evenly spaced markers determine the roll only modulo the angle between neighbours; no method can determine
  more.
* Scenes, not frames, are split: frames of one scene share sky, sun and ground, and are not independent draws."""


def plain_line(text: str) -> str:
    """A text from a recipe or manifest as one line that is neither HTML, nor Markdown's code or links."""
    line = " ".join(text.split()).translate(_PLAIN)
    return "".join(character for character in line if character.isprintable())


def card_text(manifest: Manifest) -> str:
    """The card as Markdown with YAML front matter; depends on the manifest alone."""
    # The files are pairs with their truth beside them, not rows of a table.
    values = {**card_metadata(manifest), "viewer": False}
    # JSON's strings and lists are YAML's.
    lines = [f"{key}: {json.dumps(value)}" for key, value in values.items()]
    return "\n".join(["---", *lines, "---", "", card_summary(manifest), _files(manifest), card_sections(manifest)])


def write_card(dataset: Location, manifest: Manifest) -> Location:
    """Write the card into the dataset.

    Raises:
        OSError: it cannot be written.
    """
    open_storage(dataset).write(CARD_FILE, card_text(manifest).encode())
    return join(dataset, CARD_FILE)


def citation(manifest: Manifest) -> str:
    """A BibTeX entry, which identifies the data by their hash."""
    version = plain_line(manifest.software.get("droguekit", "")).replace("{", "(").replace("}", ")")
    return "\n".join(
        [
            f"@misc{{{manifest.name},",
            f"  title = {{{manifest.name}: synthetic stereo images of an aerial-refuelling drogue}},",
            "  author = {{The droguekit project}},",
            f"  howpublished = {{Made with droguekit {version}}},",
            f"  note = {{dataset sha256 {manifest.dataset_sha256}}}",
            "}",
        ]
    )


def card_metadata(manifest: Manifest) -> dict[str, Any]:
    """What the Hub lists and finds a dataset by, for the card's front matter."""
    images = 2 * manifest.counts.pairs
    size = next((name for limit, name in _SIZES if images < limit), _LARGEST)
    return {
        "pretty_name": manifest.name,
        "license": manifest.data_licence.lower(),
        "annotations_creators": ["machine-generated"],
        "source_datasets": ["original"],
        "task_categories": ["object-detection", "keypoint-detection"],
        "tags": list(_TAGS),
        "size_categories": [size],
    }


def card_summary(manifest: Manifest) -> str:
    """The dataset's name as a title, what it shows, and the first items of its contents."""
    recipe, camera = manifest.recipe, manifest.recipe.rig.camera
    counts, sensor = manifest.counts, plain_line(recipe.sensor.name)
    splits = ", ".join(f"{name} {counts.by_split[name]}" for name in ("train", "val", "test"))
    missing = recipe.frames.count - counts.pairs
    gaps = f" {missing} of the recipe's {recipe.frames.count} pairs are not in it." if missing else ""
    return f"""# {manifest.name}

{plain_line(recipe.description) or "Synthetic stereo images of an aerial-refuelling drogue."}

## What is in it
* {counts.pairs} stereo pairs ({2 * counts.pairs} images of {camera.width_px} x {camera.height_px}) of \
{len(counts.by_scene)} scenes, {counts.empty} of them without a drogue.{gaps}
* Pairs by split: {splits}.
* Distance of the drogue: {_distance(recipe.distance)}.
* Cameras: baseline {recipe.rig.baseline_m:g} m, focal length {camera.fx_px:g} px, sensor `{sensor}`."""


def _files(manifest: Manifest) -> str:
    rangefinder = (
        "\n* `frame.rangefinder_reading_m` in the records is what a laser rangefinder beside the camera reads, with "
        "the errors that the recipe states. It is a reference with errors of its own, not the truth."
        if manifest.recipe.rangefinder is not None
        else ""
    )
    return f"""\
* For every pair the images, the part that each pixel sees, and `record.json`: pose at the middle and the ends of the
  exposure, every marker's centre and visibility in both eyes, boxes, light, exposure, and all that the frame was made
  from.{rangefinder}
* `annotations/` has boxes, masks and keypoints as COCO, `calibration/` the rig, `croissant.json` this in
  machine-readable form.

`manifest.json` states axes, units and pixel conventions under `conventions`, and the hash of every record.
"""


def card_sections(manifest: Manifest) -> str:
    """How the dataset was made, purpose, limits, licence and how to cite it: the sections after its contents."""
    licence = plain_line(manifest.data_licence)
    software = plain_line(", ".join(f"{name} {version}" for name, version in sorted(manifest.software.items())))
    engines = plain_line(", ".join(f"{pairs} pairs by {engine}" for engine, pairs in sorted(manifest.engines.items())))
    return f"""\
## How it was made
By `droguekit` from `recipe.toml` with seed {manifest.recipe.seed}: {engines or "no pair yet"}.
Software: {software}. Dataset sha256: `{manifest.dataset_sha256}`.

`droguekit render recipe.toml --out DIR` makes it again, `droguekit validate DIR` checks every file and label, and
`droguekit reproduce DIR --frame N` makes one pair again and says whether it is the same bit for bit.

## What it is for
Training and testing detectors of the drogue, and measuring the errors of pose estimators against exact truth.

## Limits
{_LIMITS}

## Licence
The data are under {licence}: use them for anything, and name where they come from. The program that
made them has a licence of its own. No image shows a person, a place or somebody else's work.

## How to cite
```
{citation(manifest)}
```
"""


def _distance(law: DistanceLaw) -> str:
    if law.stations_m is not None:
        return "stations at " + ", ".join(f"{station:g}" for station in law.stations_m) + " m, frame by frame in turn"
    return f"{law.low_m:g} to {law.high_m:g} m, {law.law}"
