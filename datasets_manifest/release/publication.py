"""Published manifests of shipped recipes, against which a regenerated dataset can be checked."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from datasets_manifest.storage.manifest import Manifest, differing_builds
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import FeatureView, HubView, PairRecord, ViewRecord
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain

_DECIMALS = 9
_SHOWN = 8
# Numbers agree within 1e-9 on any machine (docs/reference/conventions.md).
# Rounding to nine decimals adds half a unit either way.
_TOLERANCE = 2e-9

Rounded = tuple[Annotated[float, AfterValidator(lambda value: round(value, _DECIMALS) + 0.0)], ...]


class ViewLabels(FrozenModel):
    """Labels of one eye that follow from the drawn frame alone, without a rendered pixel.

    Attributes:
        box_full_xywh_px: as in `ViewRecord`.
        centers_px: by marker, then the hub: projected centre and ellipse centre; of the hub also the inner edge's. [px]
    """

    box_full_xywh_px: Rounded
    centers_px: tuple[Rounded, ...]


class FrameLabels(FrozenModel):
    """Labels of one pair.

    Attributes:
        pose: the upper three rows of `left_from_drogue`, row by row; None without a drogue, like the views.
    """

    frame_index: int = Field(ge=0)
    pose: Rounded | None
    left: ViewLabels | None
    right: ViewLabels | None


class Publication(FrozenModel):
    """A dataset's manifest with the labels of its pairs; for a large recipe possibly only of its first ones."""

    schema_version: Literal[1] = 1
    manifest: Manifest
    labels: tuple[FrameLabels, ...]


@dataclass(frozen=True)
class PublishedComparison:
    """Comparison of a dataset with the published one of its recipe.

    Attributes:
        compared: number of pairs in both.
        identical: number of those whose record, and with it every image, is identical bit for bit.
        label_faults: labels that differ, and other reasons why the datasets cannot be equal, a line each.
        build_differences: differences in software and processor from the published dataset, a line each.
    """

    compared: int
    identical: int
    label_faults: tuple[str, ...]
    build_differences: tuple[str, ...]

    @property
    def verdict(self) -> Literal["identical", "equivalent", "different"]:
        """`identical` bit for bit; `equivalent`: equal labels from another build; or `different`."""
        if self.label_faults or self.compared == 0:
            return "different"
        if self.identical == self.compared:
            return "identical"
        return "equivalent" if self.build_differences else "different"


def publication_names() -> list[str]:
    """Names of the recipes with a published manifest."""
    folder = files("datasets_manifest") / "published"
    return sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))


def read_publication(name: str) -> Publication:
    """The published manifest of a recipe.

    Raises:
        ValueError: there is none, or it does not belong to this version of the program.
    """
    if name not in publication_names():
        raise ValueError(
            f"published: there is no manifest of {name!r}; there are {', '.join(publication_names()) or 'none'}"
        )
    text = (files("datasets_manifest") / "published" / f"{name}.json").read_text(encoding="utf-8")
    try:
        return Publication.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(f"published/{name}.json: {explain(error)}; `make publish` renews it") from error


def build_publication(dataset: Location) -> Publication:
    """The publication of a dataset: its manifest and labels.

    Raises:
        ValueError: it cannot be read, or has dropped frames.
    """
    source = Dataset(dataset)
    if source.manifest.drops:
        raise ValueError(
            f"{dataset}: has dropped frames, and is not published; first {source.manifest.drops[0].reason}"
        )
    labels = tuple(published_labels(source.record(frame_index)) for frame_index in source.frame_indices)
    return Publication(manifest=source.manifest, labels=labels)


def publication_text(publication: Publication) -> str:
    """JSON with a line for each pair, so that version control shows differences."""
    manifest = json.dumps(publication.manifest.model_dump(mode="json"), indent=1, allow_nan=False)
    lines = ",\n".join(canonical_json(labels.model_dump(mode="json")) for labels in publication.labels)
    return f'{{"schema_version": {publication.schema_version}, "manifest": {manifest}, "labels": [\n{lines}\n]}}\n'


def published_labels(record: PairRecord) -> FrameLabels:
    """The labels that are published of a record."""
    pose = record.left_from_drogue
    return FrameLabels(
        frame_index=record.frame_index,
        pose=None if pose is None else tuple(pose.as_matrix()[:3].ravel().tolist()),
        left=_view_labels(record.views.left),
        right=_view_labels(record.views.right),
    )


def _view_labels(view: ViewRecord) -> ViewLabels | None:
    if view.box_full_xywh_px is None:
        return None
    features: Sequence[FeatureView] = (*view.markers, *(() if view.hub is None else (view.hub,)))
    return ViewLabels(box_full_xywh_px=view.box_full_xywh_px, centers_px=tuple(map(_centers, features)))


def _centers(feature: FeatureView) -> tuple[float, ...]:
    inner = feature.center_ellipse_inner_px if isinstance(feature, HubView) else ()
    return (*feature.center_proj_px, *feature.center_ellipse_px, *inner)


def compare_with_published(dataset: Location, published: Publication) -> PublishedComparison:
    """Compare a dataset with the published one of its recipe, pair by pair.

    The dataset's files are assumed to match its manifest, which `validate` checks.

    Raises:
        ValueError: the dataset or a record cannot be read.
    """
    source = Dataset(dataset)
    mine, theirs = source.manifest, published.manifest
    # Presets are computed, so their last bits may differ too.
    differing = _differing(theirs.recipe.model_dump(mode="json"), mine.recipe.model_dump(mode="json"))
    if differing:
        fault = f"{dataset}: its recipe is not the published {theirs.name}: {', '.join(differing[:_SHOWN])}"
        return PublishedComparison(0, 0, (fault,), ())
    known = {entry.frame_index: entry.record_sha256 for entry in theirs.frames}
    labels = {entry.frame_index: entry for entry in published.labels}
    common = [entry for entry in mine.frames if entry.frame_index in known]
    other = [entry.frame_index for entry in common if entry.record_sha256 != known[entry.frame_index]]
    faults = [fault for i in other for fault in differing_labels(labels[i], published_labels(source.record(i)))]
    if mine.render_version != theirs.render_version:
        faults.insert(
            0,
            f"published by render version {theirs.render_version}, this is {mine.render_version}; "
            "`make publish` is due where that is the newer one",
        )
    if not common:
        faults.append(f"{dataset}: has none of the {len(known)} published pairs")
    return PublishedComparison(len(common), len(common) - len(other), tuple(faults), _build_differences(theirs, mine))


def differing_labels(published: FrameLabels, own: FrameLabels) -> list[str]:
    """Labels of a pair that differ by more than rounding, a line each."""
    found = _differing(published.model_dump(mode="json"), own.model_dump(mode="json"))
    return [f"frame {published.frame_index}: {where}: differs from what was published" for where in found]


def _differing(published: Any, own: Any, where: str = "") -> list[str]:
    """Dotted keys at which two JSON values differ by more than the last bits of numbers."""
    if isinstance(published, dict) and isinstance(own, dict) and published.keys() == own.keys():
        return [
            found for key in published for found in _differing(published[key], own[key], f"{where}.{key}".lstrip("."))
        ]
    if isinstance(published, list) and isinstance(own, list) and len(published) == len(own):
        pairs = enumerate(zip(published, own, strict=True))
        return [found for k, (a, b) in pairs for found in _differing(a, b, f"{where}[{k}]")]
    if isinstance(published, float) and isinstance(own, float):
        return [] if math.isclose(published, own, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE) else [where]
    return [] if published == own else [where]


def _build_differences(theirs: Manifest, mine: Manifest) -> tuple[str, ...]:
    found = differing_builds(theirs.software, theirs.cpu_features, mine.software, mine.cpu_features)
    engines = " and ".join(sorted(theirs.engines)), " and ".join(sorted(mine.engines))
    return (*found, *([f"{engines[0]} there, {engines[1]} here"] if engines[0] != engines[1] else ()))
