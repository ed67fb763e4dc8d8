"""The corpora of the shipped weights and of their tests, and which training learns from which."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
from scenes.sampler import scene_of_frame

_HERE = Path(__file__).parent
# Of `detector-train`. The even ones behind the first 320 come from a run that was begun with more frames.
CORPUS_FRAMES = sorted({*range(320), *range(1, 1440, 2)} | {330, 340, 370, 380, 384, 404, 424, 430})
# Of `more-scenes.toml`: as many as its rendering had completed when the training began.
MORE_SCENES = 217
# Of `detector-negatives`, for the same reason.
NEGATIVE_SCENES = 240
# Flat rings without paths of light: pictures of a renderer that no other corpus has, at the others' size.
FLAT = {
    "name": "detector-flat",
    "seed": 9,
    "frames": {"count": 200, "scenes": 200, "empty_fraction": 0.1},
    "rig": {
        "preset": "rgb-ideal",
        "encoding": "gamma",
        "width_px": 640,
        "height_px": 480,
        "focal_px": 1066.6666666666667,
    },
    "render": {"engine": "analytic"},
}
# Of the later trainings of `s`: scenes of the same recipes that those before did not see, or fewer of them.
LATER_CORPUS = {"frames": {"count": 560, "scenes": 140}}
LATER_SCENES, LATER_NEGATIVE_SCENES = 417, 400
# Of `missed-scenes.toml`: as many as its rendering had completed when the training began.
MISSED_SCENES = 83
ALL_MISSED_SCENES = 200
# Round things that detectors take for drogues, in frames without one, and many of them to validate with.
ROUND = {
    "name": "detector-round",
    "seed": 11,
    "frames": {"count": 400, "scenes": 134, "empty_fraction": 1.0},
    "target": {
        "distractor_frame_fraction": 0.75,
        "distractor_forms": ["roundel"] * 4
        + ["wheel"] * 2
        + ["nacelle", "intake", "antenna", "lamp", "bird", "pod", "ring", "disc"],
    },
    "split": {"train": 0.6, "val": 0.4, "test": 0},
}
# Of `missed-scenes.toml`, as far as multirotors carry them: cones, which detectors take for roundels, beside roundels.
CONES = {
    "name": "detector-cones",
    "seed": 12,
    "frames": {"count": 320, "scenes": 80, "empty_fraction": 0.2},
    "split": {"train": 0.9, "val": 0.1, "test": 0},
}
_CONES_TARGET = {
    "variants": [
        {"drogue": "cone-orange", "weight": 6},
        {"drogue": "cone-white", "weight": 6},
        {"drogue": "cone-markers", "weight": 4},
        {"drogue": "red-8", "weight": 2},
    ],
    "distractor_forms": ["roundel", "roundel", "disc", "disc", "ball", "bird", "ring", "wheel"],
}
# Small cones fill few pixels from afar; these come near, and most are orange, which trainings find hardest to tell from
# roundels.
NEAR_CONES = {
    "name": "detector-near-cones",
    "seed": 13,
    "frames": {"count": 320, "scenes": 107, "empty_fraction": 0.15},
    "distance": {"low_m": 2.0, "high_m": 14.0},
    "split": {"train": 0.9, "val": 0.1, "test": 0},
}
_NEAR_CONES_TARGET = {
    **_CONES_TARGET,
    "variants": [
        {"drogue": "cone-orange", "weight": 12},
        {"drogue": "cone-white", "weight": 3},
        {"drogue": "cone-markers", "weight": 3},
        {"drogue": "basket-small-orange", "weight": 2},
        {"drogue": "red-8"},
    ],
}
# Behind the later ones of `more-scenes.toml`.
NEWEST_SCENES, LAST_SCENES = 492, 560
# Beside the photographs from the third training on.
PLAIN_GROUNDS = 24
# Frames without a drogue, two images each, to count false boxes in: the test set's, but for scenes and seed.
EMPTY = {"name": "detector-empty", "seed": 5, "frames": {"count": 300, "scenes": 100, "empty_fraction": 1.0}}


@dataclass(frozen=True)
class Training:
    """One training of several, each from the weights of the one before it.

    Attributes:
        name: of its settings and its folder, behind that of the network's variant.
        corpora: folders of the datasets that it learns from.
        has_grounds: whether drogues are pasted on plain grounds too.
    """

    name: str
    corpora: tuple[str, ...]
    has_grounds: bool = False

    def settings(self, variant: str) -> Path:
        """The file of its settings for a network's variant."""
        return _HERE / f"{variant}-{self.name}.toml"


_FIRST, _SECOND = ("corpus", "more"), ("corpus", "more", "negatives", "flat")
_FOURTH = ("later-corpus", "later-more", "later-negatives", "missed", "flat")
_SIXTH = (*_FOURTH, "negatives", "round")
_SEVENTH = (*_SIXTH, "cones", "newest-more")
_EIGHTH = (*_SEVENTH, "later-missed")
_THREE = (Training("first", _FIRST), Training("second", _SECOND), Training("third", _SECOND, has_grounds=True))
# A fifth training led nowhere, see RESULTS.md.
TRAININGS: dict[str, tuple[Training, ...]] = {
    "l": (*_THREE, Training("fourth", _SIXTH, has_grounds=True), Training("fifth", _SEVENTH, has_grounds=True)),
    "s": (
        *_THREE,
        Training("fourth", _FOURTH, has_grounds=True),
        Training("sixth", _SIXTH, has_grounds=True),
        Training("seventh", _SEVENTH, has_grounds=True),
        Training("eighth", _EIGHTH, has_grounds=True),
        Training("ninth", (*_EIGHTH, "near-cones", "last-more"), has_grounds=True),
    ),
}


def frames_of_first_scenes(recipe: Recipe, scenes: int) -> list[int]:
    """Indices of all frames of the scenes that the first frames show, one each."""
    first = {scene_of_frame(recipe, index) for index in range(scenes)}
    return [index for index in range(recipe.frames.count) if scene_of_frame(recipe, index) in first]


def datasets(variant: str) -> dict[str, tuple[RecipeSource, Sequence[int]]]:
    """Recipe and frames of the folders that a variant's trainings and their test need."""
    more, negatives = load_recipe(str(_HERE / "more-scenes.toml")), load_recipe("detector-negatives")
    missed, test = load_recipe(str(_HERE / "missed-scenes.toml")), str(_HERE / "test.toml")
    whole = {
        "flat": load_recipe("detector-small", changes=FLAT),
        "later-corpus": load_recipe("detector-train", changes=LATER_CORPUS),
        "round": load_recipe(test, changes=ROUND),
        "cones": _cones(CONES, _CONES_TARGET),
        "near-cones": _cones(NEAR_CONES, _NEAR_CONES_TARGET),
        "test": load_recipe(test),
        "empty": load_recipe(test, changes=EMPTY),
    }
    every: dict[str, tuple[RecipeSource, Sequence[int]]] = {
        "corpus": (load_recipe("detector-train"), CORPUS_FRAMES),
        "more": (more, frames_of_first_scenes(more.recipe, MORE_SCENES)),
        "later-more": (more, _frames_behind(more.recipe, MORE_SCENES, LATER_SCENES)),
        "negatives": (negatives, frames_of_first_scenes(negatives.recipe, NEGATIVE_SCENES)),
        "later-negatives": (negatives, _frames_behind(negatives.recipe, NEGATIVE_SCENES, LATER_NEGATIVE_SCENES)),
        "newest-more": (more, _frames_behind(more.recipe, LATER_SCENES, NEWEST_SCENES)),
        "last-more": (more, _frames_behind(more.recipe, NEWEST_SCENES, LAST_SCENES)),
        "missed": (missed, frames_of_first_scenes(missed.recipe, MISSED_SCENES)),
        "later-missed": (missed, _frames_behind(missed.recipe, MISSED_SCENES, ALL_MISSED_SCENES)),
        **{name: (source, range(source.recipe.frames.count)) for name, source in whole.items()},
    }
    needed = {name for training in TRAININGS[variant] for name in training.corpora} | {"test", "empty"}
    return {name: dataset for name, dataset in every.items() if name in needed}


def _cones(changes: dict[str, object], target: dict[str, object]) -> RecipeSource:
    """The family of multirotors of `missed-scenes.toml` alone, with other drogues and distractors."""
    path = _HERE / "missed-scenes.toml"
    families = tomllib.loads(path.read_text(encoding="utf-8"))["families"]
    family = next(each for each in families if each["name"] == "multirotor")
    return load_recipe(str(path), changes={**changes, "families": [{**family, "target": target}]})


def _frames_behind(recipe: Recipe, first: int, last: int) -> list[int]:
    """Indices of all frames of the scenes from number `first` to before `last`."""
    return sorted(set(frames_of_first_scenes(recipe, last)) - set(frames_of_first_scenes(recipe, first)))
