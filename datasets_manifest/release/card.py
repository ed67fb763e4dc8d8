"""The dataset's card, and its description in Croissant, a metadata format for search engines and data loaders.

The card tells contents, origin, purpose and limits in words, with Hugging Face's metadata.

Source: Croissant Format Specification 1.0, MLCommons, http://mlcommons.org/croissant/1.0.
"""

from __future__ import annotations

import json
from typing import Any

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.storage.frame_store import read_pairs_per_tar, sha256_of
from datasets_manifest.storage.layout import (
    ANNOTATIONS_FOLDER,
    CARD_FILE,
    CROISSANT_FILE,
    FRAMES_FOLDER,
    MANIFEST_FILE,
    RECORD_FILE,
    SHARDS_FOLDER,
    image_file,
    parts_file,
)
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.storage import Location, Storage, join, open_storage
from geometry.stereo import EYES

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


_LICENCE_URLS = {"CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/"}
# Appendix 1 of the specification; names that are not in it are those of schema.org.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_INTEGER, _FLOAT, _TEXT, _BOOLEAN = "sc:Integer", "sc:Float", "sc:Text", "sc:Boolean"
_PAIR_FIELDS = (
    ("frame_index", _INTEGER, "Index of the pair; its folder is frames/ and this number with six digits."),
    ("scene_id", _INTEGER, "Drawn environment; pairs of one scene are never in two splits."),
    ("split", _TEXT, "train, val or test."),
    ("empty", _BOOLEAN, "Whether the pair shows no drogue."),
    ("record_sha256", _TEXT, "Hash of the pair's record, which holds the hashes of its other files."),
)
_TRUTH_FIELDS = (
    ("frame_index", "frame_index", _INTEGER, "Index of the pair."),
    ("time_s", "time_s", _FLOAT, "Time of the middle of the exposure. [s]"),
    ("distance_m", "conditions.distance_m", _FLOAT, "Distance of the rim's centre along the left optical axis. [m]"),
    ("pitch_deg", "pitch_deg", _FLOAT, "Pitch of the drogue in the left camera. [deg]"),
    ("yaw_deg", "yaw_deg", _FLOAT, "Yaw of the drogue in the left camera. [deg]"),
    ("roll_deg", "roll_deg", _FLOAT, "Roll of the drogue in the left camera. [deg]"),
    ("family", "conditions.family", _TEXT, "Kind of conditions."),
)
_SETS = (
    ("records", RECORD_FILE, "application/json", "The truth of each pair."),
    *((f"{eye}-images", image_file(eye), "image/png", f"What the {eye} camera saw.") for eye in EYES),
    *((f"{eye}-parts", parts_file(eye), "image/png", f"Part id of each pixel of the {eye} eye.") for eye in EYES),
)
_SHARDS = "shards"


def write_croissant(dataset: Location, manifest: Manifest) -> Location:
    """Write `croissant.json` into a dataset whose manifest and annotations are written.

    Raises:
        OSError: it cannot be written, or a file that it names cannot be read.
    """
    text = json.dumps(describe_croissant(dataset, manifest), indent=1, allow_nan=False, ensure_ascii=False)
    open_storage(dataset).write(CROISSANT_FILE, f"{text}\n".encode())
    return join(dataset, CROISSANT_FILE)


def describe_croissant(dataset: Location, manifest: Manifest) -> dict[str, Any]:
    """The description as JSON-LD; it does not depend on location or time.

    Raises:
        OSError: a file that it names cannot be read.
    """
    storage = open_storage(dataset)
    is_packed = read_pairs_per_tar(storage) is not None
    names = storage.names(ANNOTATIONS_FOLDER)
    annotations = [f"{ANNOTATIONS_FOLDER}/{name}" for name in names if name.endswith(".json") and name[0] != "."]
    shards = [_shards()] if is_packed else []
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": manifest.name,
        "description": manifest.recipe.description or f"Synthetic stereo images of a drogue: {manifest.name}.",
        "license": _LICENCE_URLS.get(manifest.data_licence, manifest.data_licence),
        "version": f"{manifest.recipe.seed}.{manifest.render_version}.0",
        "creator": {"@type": "sc:Organization", "name": "The droguekit project"},
        "keywords": ["aerial refuelling", "drogue", "stereo", "pose estimation", "synthetic data"],
        "citeAs": citation(manifest),
        "isLiveDataset": False,
        "distribution": [
            _file(storage, MANIFEST_FILE, "What the dataset is made of and how it was made."),
            *(_file(storage, name, "COCO boxes, masks and keypoints.") for name in annotations),
            *shards,
            *(_file_set(name, file, encoding, text, is_packed) for name, file, encoding, text in _SETS),
        ],
        "recordSet": [_pairs(), _truth(), *(_images(eye, is_packed) for eye in EYES)],
    }


def _file(storage: Storage, name: str, description: str) -> dict[str, Any]:
    with storage.open(name) as stream:
        digest = sha256_of(stream)
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name.rpartition("/")[2],
        "description": description,
        "contentUrl": name,
        "contentSize": f"{storage.size(name)} B",
        "encodingFormat": "application/json",
        "sha256": digest,
    }


def _shards() -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": _SHARDS,
        "name": _SHARDS,
        "description": "Archives of the files of many pairs.",
        "encodingFormat": "application/x-tar",
        "includes": f"{SHARDS_FOLDER}/*.tar",
    }


def _file_set(name: str, file: str, encoding: str, description: str, is_packed: bool) -> dict[str, Any]:
    place = (
        {"containedIn": {"@id": _SHARDS}, "includes": f"*.{file}"}
        if is_packed
        else {"includes": f"{FRAMES_FOLDER}/*/{file}"}
    )
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": description,
        "encodingFormat": encoding,
        **place,
    }


def _pairs() -> dict[str, Any]:
    fields = [
        _field("pairs", name, type_, description, {"fileObject": {"@id": MANIFEST_FILE}}, f"$.frames[*].{name}")
        for name, type_, description in _PAIR_FIELDS
    ]
    return _record_set("pairs", "Every pair of the dataset.", fields)


def _truth() -> dict[str, Any]:
    fields = [
        _field("truth", name, type_, description, {"fileSet": {"@id": "records"}}, f"$.{path}")
        for name, path, type_, description in _TRUTH_FIELDS
    ]
    return _record_set("truth", "Pose of the drogue in each pair; missing values where there is none.", fields)


def _images(eye: str, is_packed: bool) -> dict[str, Any]:
    set_name = f"{eye}-images"
    source = {"fileSet": {"@id": set_name}}
    folder = {
        **source,
        "extract": {"fileProperty": "fullpath"},
        "transform": {"regex": r"(?:.*[/\\])?(\d+)" + (r"\." if is_packed else r"[/\\]") + r"[^/\\]+$"},
    }
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"{eye}/frame_index",
            "name": "frame_index",
            "description": "Index of the pair.",
            "dataType": _INTEGER,
            "source": folder,
        },
        {
            "@type": "cr:Field",
            "@id": f"{eye}/image",
            "name": "image",
            "description": f"What the {eye} camera saw.",
            "dataType": "sc:ImageObject",
            "source": {**source, "extract": {"fileProperty": "content"}},
        },
    ]
    return _record_set(eye, f"Images of the {eye} camera.", fields)


def _record_set(name: str, description: str, fields: list[dict[str, Any]]) -> dict[str, Any]:
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": description, "field": fields}


def _field(
    record_set: str, name: str, type_: str, description: str, source: dict[str, Any], json_path: str
) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{name}",
        "name": name,
        "description": description,
        "dataType": type_,
        "source": {**source, "extract": {"jsonPath": json_path}},
    }
