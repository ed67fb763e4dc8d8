"""The dataset's description in Croissant, a metadata format for search engines and data loaders.

Source: Croissant Format Specification 1.0, MLCommons, http://mlcommons.org/croissant/1.0.
"""

from __future__ import annotations

import json
from typing import Any

from datasets_manifest.release.card import citation
from datasets_manifest.storage.frame_store import read_pairs_per_tar, sha256_of
from datasets_manifest.storage.layout import (
    ANNOTATIONS_FOLDER,
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
