"""How two datasets differ: keys of their recipes, software, laws of their labels, and statistics of their pixels.

Pairs of one scene share its sky, so that they are no independent draws. A number that scenes sway (test of Kruskal and
Wallis), and every word, counts once for each scene or sequence; other numbers count once for each pair.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from drogue_models.frozen_model import FrozenModel
from droguekit.assurance.design_domain import NUMBERS, WORDS
from droguekit.assurance.law_comparison import LawDiff, Units, compare_changes, compare_numbers, compare_words
from droguekit.batch.progress import PlainProgress, ProgressReport

FALSE_ALARMS = 0.005
"""Chance that two datasets of one law differ in any row; shared evenly between the rows (Bonferroni)."""
# Below this scenes are said to sway a number.
_SWAYED = 0.01
_MOST_SHOWN, _MOST_TEXT = 12, 120
# Of a frame: how light becomes pixels.
_PIPELINE = {"sensor", "camera"}


class KeyDiff(FrozenModel):
    """A key of recipe or manifest with two values, as JSON; empty where it is missing."""

    key: str
    a: str
    b: str


class DatasetDiff(FrozenModel):
    """How two datasets differ.

    Attributes:
        names, sha256, pairs: of A and of B.
        same_frames: pairs of one index that show the very same scene and pose, whatever sensor and camera make of it.
        same_pixels: of the pairs compared, where all frames are the same: those in which both images are equal.
        compared: pairs whose pixels were compared, of each.
        recipe, manifest: keys that differ.
        labels, pixels: laws.
    """

    names: tuple[str, str]
    sha256: tuple[str, str]
    pairs: tuple[int, int]
    same_frames: int
    same_pixels: int
    compared: tuple[int, int]
    recipe: tuple[KeyDiff, ...]
    manifest: tuple[KeyDiff, ...]
    labels: tuple[LawDiff, ...]
    pixels: tuple[LawDiff, ...]

    @property
    def differs(self) -> bool:
        """Whether anything differs that draws do not explain."""
        return any(law.differs for law in self._laws)

    @property
    def can_tell(self) -> bool:
        """Whether a difference of any law could be told; of the very same frames the labels are known to agree."""
        return self._are_same or len(self.untold) < len(self._laws)

    @property
    def verdict(self) -> str:
        """The outcome in one line."""
        laws = [
            f"{kind} differ in {', '.join(found)}"
            for kind, rows in (("labels", self.labels), ("pixels", self.pixels))
            if (found := [law.name for law in rows if law.differs])
        ]
        if laws:
            return "; ".join(laws)
        if self._are_same:
            of_pixels = (
                "pixels were not compared"
                if not self.compared[0]
                else f"the same pixels in the {self.compared[0]} compared"
                if self.same_pixels == self.compared[0]
                else "pixels differ in value, not in law"
            )
            return f"the same {self.pairs[0]} frames; {of_pixels}"
        if not self.can_tell:
            return "too few scenes or pairs to tell any difference"
        few = f"; {len(self.untold)} of {len(self._laws)} laws have too few scenes or pairs to tell"
        return f"nothing differs that draws do not explain{few if self.untold else ''}"

    @property
    def untold(self) -> tuple[str, ...]:
        """Laws of which there are too few draws for any difference to be told."""
        return tuple(law.name for law in self._laws if not law.can_differ)

    @property
    def _are_same(self) -> bool:
        return self.same_frames == self.pairs[0] == self.pairs[1]

    @property
    def _laws(self) -> tuple[LawDiff, ...]:
        return *self.labels, *self.pixels


class _Drawn(NamedTuple):
    """What was drawn for a pair: its scene, and a hash of all of it."""

    scene_id: int
    digest: bytes


class _Group(NamedTuple):
    """What is drawn together."""

    scene_id: int
    sequence_id: int | None


class _Read(NamedTuple):
    """What a dataset's records say.

    Attributes:
        drawn: by frame.
        numbers, words: labels by name and group.
    """

    drawn: dict[int, _Drawn]
    numbers: dict[str, dict[_Group, list[float]]]
    words: dict[str, dict[_Group, list[str]]]


def diff_datasets(a: Location, b: Location, pairs: int = 24, report: ProgressReport | None = None) -> DatasetDiff:
    """Compare two datasets with truth.

    Args:
        a, b: the datasets.
        pairs: whose pixels are compared, at most, of each; 0 for none.
        report: is told of the progress, or None.

    Raises:
        ValueError: no such dataset, a record or image that cannot be read, a changed record, or a negative number
            of pairs.
    """
    if pairs < 0:
        raise ValueError(f"--pairs: must not be negative, got {pairs}")
    sources = Dataset(a), Dataset(b)
    first, second = (_read(source, report) for source in sources)
    for source, read in zip((a, b), (first, second), strict=True):
        if not read.drawn:
            raise ValueError(f"{source}: has no pairs")
    common = [k for k, drawn in first.drawn.items() if second.drawn.get(k) == drawn]
    are_same = 0 < len(common) == len(first.drawn) == len(second.drawn)
    chosen = [_evenly(common, pairs) if are_same else _of_each_scene(read.drawn, pairs) for read in (first, second)]
    measured = [_measure(source, which) for source, which in zip(sources, chosen, strict=True)]
    most_p = FALSE_ALARMS / (len(NUMBERS) + len(WORDS) + 1 + len(PIXEL_MEASURES))
    manifests = sources[0].manifest, sources[1].manifest
    return DatasetDiff(
        names=(manifests[0].name, manifests[1].name),
        sha256=(manifests[0].dataset_sha256, manifests[1].dataset_sha256),
        pairs=(len(first.drawn), len(second.drawn)),
        same_frames=len(common),
        same_pixels=sum(x.digest == y.digest for x, y in zip(*measured, strict=True)) if are_same else 0,
        compared=(len(chosen[0]), len(chosen[1])),
        recipe=tuple(
            _key_diffs(manifests[0].recipe.model_dump(mode="json"), manifests[1].recipe.model_dump(mode="json"))
        ),
        manifest=tuple(_key_diffs(_manifest_table(manifests[0]), _manifest_table(manifests[1]))),
        labels=tuple(_label_laws(first, second, most_p)),
        pixels=tuple(_pixel_laws(measured[0], measured[1], are_same, most_p)) if pairs else (),
    )


def _read(source: Dataset, report: ProgressReport | None) -> _Read:
    read = _Read({}, defaultdict(lambda: defaultdict(list)), defaultdict(lambda: defaultdict(list)))
    shown = PlainProgress(io.StringIO()) if report is None else report
    shown.begin("pairs", len(source.frame_indices))
    try:
        for index in source.frame_indices:
            record = source.unchanged_record(index)
            digest = _digest(record.frame.model_dump_json(exclude=_PIPELINE).encode())
            read.drawn[index] = _Drawn(record.scene_id, digest)
            _add_labels(read, record)
            shown.advance()
    finally:
        shown.end()
    return read


def _add_labels(labels: _Read, record: PairRecord) -> None:
    group = _Group(record.scene_id, record.sequence_id)
    labels.numbers["empty_fraction"][group].append(float(record.left_from_drogue is None))
    for name, number_of in NUMBERS.items():
        if (number := number_of(record)) is not None:
            labels.numbers[name][group].append(float(number))
    for name, word_of in WORDS.items():
        if (word := word_of(record)) is not None:
            labels.words[name][group].append(word)


def _label_laws(a: _Read, b: _Read, most_p: float) -> Iterator[LawDiff]:
    for name in sorted(a.numbers.keys() | b.numbers.keys()):
        sides = a.numbers.get(name, {}), b.numbers.get(name, {})
        is_grouped = any(_is_swayed(side) for side in sides)
        values = [
            np.array(
                [np.median(own) for own in side.values()] if is_grouped else [x for own in side.values() for x in own]
            )
            for side in sides
        ]
        units: Units = _groups_name(sides) if is_grouped else "pairs"
        yield compare_numbers(name, units, (values[0], values[1]), most_p)
    for name in sorted(a.words.keys() | b.words.keys()):
        sides_of_words = a.words.get(name, {}), b.words.get(name, {})
        commonest = [[Counter(own).most_common(1)[0][0] for own in side.values()] for side in sides_of_words]
        yield compare_words(name, _groups_name(sides_of_words), (commonest[0], commonest[1]), most_p)


def _groups_name(sides: tuple[Mapping[_Group, Any], ...]) -> Units:
    return "sequences" if any(group.sequence_id is not None for side in sides for group in side) else "scenes"


def _is_swayed(side: Mapping[_Group, Sequence[float]]) -> bool:
    """Whether values within a group resemble each other more than those of others; sequences always do."""
    if any(group.sequence_id is not None for group in side):
        return True
    groups = [own for own in side.values() if own]
    if len(groups) < 2 or len({x for own in groups for x in own}) < 2:
        return False
    if all(len(set(own)) == 1 for own in groups):
        return True
    return bool(stats.kruskal(*groups).pvalue < _SWAYED)


class _Measured(NamedTuple):
    """Pixels of one pair."""

    digest: bytes
    values: dict[str, float]


def _luma(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return image if image.ndim == 2 else image.mean(axis=2)


def _noise(image: NDArray[np.float32]) -> float:
    """Standard deviation of the noise, after Immerkaer 1996, doi:10.1006/cviu.1996.0060, by the median over blocks."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    residual = np.abs(cv2.filter2D(_luma(image), -1, kernel))
    return float(np.median(cv2.blur(residual, (16, 16))) * np.sqrt(np.pi / 2) / 6)


def _grain(image: NDArray[np.float32]) -> float:
    """Correlation of neighbours in what a median filter takes away, over the smoother half of the picture."""
    luma = _luma(image)
    fine = luma - cv2.medianBlur(luma, 5)
    strength = cv2.blur(np.abs(fine), (16, 16))
    fine = np.where(strength <= np.median(strength), fine, np.float32(0.0))
    power = float((fine * fine).mean())
    return float((fine[:, 1:] * fine[:, :-1]).mean() / power) if power > 0 else 0.0


def _sharpness(image: NDArray[np.float32]) -> float:
    luma = _luma(image)
    steps = np.abs(np.diff(luma, axis=1))
    return float(np.percentile(steps, 99.5) / max(float(luma.std()), 1e-6))


def _blue_over_red(image: NDArray[np.float32]) -> float:
    return 1.0 if image.ndim == 2 else float(image[..., 2].mean() / max(float(image[..., 0].mean()), 1e-6))


PIXEL_MEASURES: dict[str, Callable[[NDArray[np.float32]], float]] = {
    "mean_level": lambda image: float(image.mean()),
    "contrast": lambda image: float(_luma(image).std() / max(float(image.mean()), 1e-6)),
    "clipped_fraction": lambda image: float((image >= 1.0).mean()),
    "noise": _noise,
    "noise_correlation": _grain,
    "sharpness": _sharpness,
    "blue_over_red": _blue_over_red,
}
"""Of a left image, (H, W) or (H, W, 3) from 0 to 1 as it is stored."""


def _evenly(indices: list[int], count: int) -> list[int]:
    """At most `count` of the indices, the first and the last among them."""
    least = min(count, len(indices))
    return [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, least).astype(int))] if least else []


def _of_each_scene(drawn: Mapping[int, _Drawn], count: int) -> list[int]:
    """One frame of each of at most `count` scenes."""
    of_scene: dict[int, list[int]] = defaultdict(list)
    for index, each in drawn.items():
        of_scene[each.scene_id].append(index)
    # Of a scene not always the first, which may be special.
    by_turn = [own[(rank * 7) % len(own)] for rank, own in enumerate(of_scene.values())]
    return sorted(_evenly(by_turn, count))


def _measure(source: Dataset, indices: Sequence[int]) -> list[_Measured]:
    found = []
    for index in indices:
        images = source.images(index)
        scaled = images.left.astype(np.float32) / np.float32(2**images.bits - 1)
        values = {name: measure(scaled) for name, measure in PIXEL_MEASURES.items()}
        found.append(_Measured(_digest(images.left.tobytes() + images.right.tobytes()), values))
    return found


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def _pixel_laws(a: Sequence[_Measured], b: Sequence[_Measured], are_same: bool, most_p: float) -> Iterator[LawDiff]:
    for name in PIXEL_MEASURES:
        values = tuple(np.array([one.values[name] for one in side]) for side in (a, b))
        if are_same:
            yield compare_changes(name, (values[0], values[1]), most_p)
        else:
            yield compare_numbers(name, "scenes", (values[0], values[1]), most_p)


def _manifest_table(manifest: Manifest) -> dict[str, Any]:
    return {
        "render_version": manifest.render_version,
        "software": manifest.software,
        "cpu_features": " ".join(manifest.cpu_features),
        "engines": manifest.engines,
        "drops": len(manifest.drops),
        "data_licence": manifest.data_licence,
    }


def _key_diffs(a: Any, b: Any, prefix: str = "") -> Iterator[KeyDiff]:
    """Keys of nested tables and lists whose values differ; a missing key is one difference."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted(a.keys() | b.keys()):
            name = f"{prefix}.{key}" if prefix else key
            yield from _key_diffs(a.get(key, _MISSING), b.get(key, _MISSING), name)
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for place, (own, other) in enumerate(zip(a, b, strict=True)):
            yield from _key_diffs(own, other, f"{prefix}[{place}]")
    elif a != b:
        yield KeyDiff(key=prefix, a=_text(a), b=_text(b))


_MISSING = object()


def _text(value: Any) -> str:
    if value is _MISSING:
        return ""
    text = json.dumps(value)
    return text if len(text) <= _MOST_TEXT else text[: _MOST_TEXT - 3] + "..."


def diff_lines(found: DatasetDiff) -> Iterator[str]:
    """What a terminal shows: both datasets, what differs, and the verdict."""
    for which, name, sha256, pairs in zip("AB", found.names, found.sha256, found.pairs, strict=True):
        yield f"{which}: {name}, {pairs} pairs, {sha256[:12]}"
    for what, keys in (("recipe", found.recipe), ("manifest", found.manifest)):
        for key in keys[:_MOST_SHOWN]:
            yield f"{what} {key.key}: {key.a or 'missing'} | {key.b or 'missing'}"
        if len(keys) > _MOST_SHOWN:
            yield f"{what}: and {len(keys) - _MOST_SHOWN} more keys"
    yield f"same frames: {found.same_frames}"
    yield f"{'':<28} {'of A':>12} {'of B':>12} {'distance':>9} {'p':>8}"
    for law in (*found.labels, *found.pixels):
        mark = "  differs" if law.differs else ""
        a, b = (text[:12] for text in law.typical)
        yield f"{law.name:<28} {a:>12} {b:>12} {law.distance:9.3f} {law.p:8.2g}{mark}"
    if found.untold:
        yield f"too few scenes or pairs to tell a difference: {', '.join(found.untold)}"
    yield found.verdict
