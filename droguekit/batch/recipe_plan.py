"""What a recipe will make, without rendering: counts, distances, boxes and places, tested against the recipe's laws.

The tests are chi-square tests. Sizes: the distance follows the recipe's law, and the box's side goes with its inverse.
Places: the middle of the box is anywhere in the left image where both views hold all of the drogue, all such places
being equally likely.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import Drop
from drogue_models.parameters import DrogueParameters
from droguekit.batch.frame_task import FIRST_FRAMES, make_drop
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, StereoRig
from labelgen.part_pixels import drogue_box
from scenes.drogue_appearance import drogue_of_scene
from scenes.sampler import family_of_scene, left_from_drogue_in_scene, recipe_of_scene, scene_of_frame, split_of_scenes

# A worker may load its engine and compile kernels within its first frame.
_START_S = 300.0
# Our choice, far above what any engine takes for one sample of one pixel.
_S_PER_SAMPLE = 20e-6
# Shares to within 3 %, in two seconds.
_MOST_SAMPLED = 1000
# A mesh takes a tenth of a second, and recipes may have a drogue for each of hundreds of scenes.
_MOST_DROGUES = 24
# Frames among which those of the chosen scenes are looked for.
_MOST_LOOKED_AT = 10_000
# Distance, middle and side of the box, room of its middle.
_COLUMNS = 8
SIZE_BINS = 10
PLACE_COLUMNS, PLACE_ROWS = 8, 6
# Cochran's rule: with fewer expected in a cell the statistic does not follow chi-square.
_FEWEST_EXPECTED = 5.0
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class DrawnFrames:
    """Random draws of a recipe's frames; NaN where a frame has no drogue.

    Attributes:
        indices: (N,) of the frames, ascending, without those that cannot be made.
        scenes: (N,) scene of each.
        families: (N,) index of its family in the recipe, 0 without families.
        distances_m: (N,) of the rim centre along the optical axis. [m]
        centers_px: (N, 2) middle of the drogue's full box in the left image. [px]
        sides_px: (N,) side of the square with that box's area. [px]
        rooms_px: (N, 4) lowest and highest u, lowest and highest v, between which the middle of the box may lie so that
            both views hold all of the drogue; NaN also where the place is not drawn. [px]
        drops: requested frames that cannot be made, and why.
    """

    indices: tuple[int, ...]
    scenes: Array
    families: Array
    distances_m: Array
    centers_px: Array
    sides_px: Array
    rooms_px: Array
    drops: tuple[Drop, ...] = ()


@dataclass(frozen=True)
class RecipePlan:
    """What a recipe will make.

    Attributes:
        by_split: pairs in each split, including those that cannot be made.
        by_scene: pairs in each scene, likewise.
        by_family: scenes and pairs of each family, in the recipe's order; empty without families.
        drawn: the frames that were drawn.
    """

    by_split: dict[str, int]
    by_scene: dict[int, int]
    by_family: dict[str, tuple[int, int]]
    drawn: DrawnFrames

    @property
    def empty_fraction(self) -> float:
        """Share of the drawn frames without a drogue."""
        return float(np.isnan(self.drawn.distances_m).mean())

    @property
    def dropped_fraction(self) -> float:
        """Share of the drawn frames that cannot be made."""
        drops = len(self.drawn.drops)
        return drops / (drops + len(self.drawn.indices))


def family_index(recipe: Recipe, scene_id: int) -> int:
    """Place of a scene's family in the recipe, 0 without families."""
    family = family_of_scene(recipe, scene_id)
    return 0 if family is None else [one.name for one in recipe.families].index(family.name)


def plan_recipe(recipe: Recipe, most_sampled: int = _MOST_SAMPLED) -> RecipePlan:
    """Count the pairs of a recipe, and draw some of its frames.

    Args:
        recipe: to plan.
        most_sampled: frames to draw at most, spread evenly over the recipe, or over 24 of its scenes where more
            scenes have drogues of their own.

    Raises:
        ValueError: none of the first ones can be made.
    """
    by_scene, splits = _pairs_by_scene(recipe), split_of_scenes(recipe)
    by_split: Counter[str] = Counter()
    for scene_id, pairs in by_scene.items():
        by_split[splits[scene_id]] += pairs
    by_family = {family.name: (0, 0) for family in recipe.families}
    scenes_by_family: dict[str, list[int]] = {}
    for scene_id, pairs in by_scene.items():
        family = family_of_scene(recipe, scene_id)
        name = "" if family is None else family.name
        scenes_by_family.setdefault(name, []).append(scene_id)
        if family is not None:
            scenes, total = by_family[name]
            by_family[name] = scenes + 1, total + pairs
    indices = _frames_to_draw(recipe, [scene for scenes in scenes_by_family.values() for scene in scenes], most_sampled)
    return RecipePlan(dict(by_split), dict(by_scene), by_family, draw_frames(recipe, indices))


def _frames_to_draw(recipe: Recipe, scenes_by_family: Sequence[int], most_sampled: int) -> tuple[int, ...]:
    """Indices of frames, ascending, of scenes with at most `_MOST_DROGUES` drogues; scenes one family after another."""
    count = recipe.frames.count
    drogues = {drogue_of_scene(recipe_of_scene(recipe, scene_id), scene_id) for scene_id in scenes_by_family}
    if len(drogues) <= _MOST_DROGUES:
        return _evenly(range(count), most_sampled)
    # Evenly over scenes that stand family by family, so that families keep their shares.
    chosen = set(_evenly(scenes_by_family, _MOST_DROGUES))
    looked_at = _evenly(range(count), _MOST_LOOKED_AT)
    return _evenly([index for index in looked_at if scene_of_frame(recipe, index) in chosen], most_sampled)


def _evenly(values: Sequence[int], most: int) -> tuple[int, ...]:
    """At most so many of the values, the first and the last among them."""
    places = np.linspace(0, len(values) - 1, min(len(values), most))
    return tuple(values[place] for place in sorted({int(place) for place in places}))


def frame_timeout_s(recipe: Recipe) -> float:
    """Time after which a frame counts as hung, far longer than any engine needs. [s]"""
    camera = recipe.rig.camera
    samples = 2 * camera.width_px * camera.height_px * recipe.render.samples_per_px
    return _START_S + float(round(_S_PER_SAMPLE * samples))


def _pairs_by_scene(recipe: Recipe) -> Counter[int]:
    count, scenes = recipe.frames.count, recipe.frames.scenes
    length = 1 if recipe.sequence is None else recipe.sequence.frames_per_sequence
    # As many consecutive frames, or sequences, as there are scenes visit each scene once.
    rounds = count // (scenes * length)
    by_scene = Counter(dict.fromkeys(range(scenes), rounds * length))
    by_scene.update(scene_of_frame(recipe, frame_index) for frame_index in range(rounds * scenes * length, count))
    return by_scene


def draw_frames(recipe: Recipe, indices: tuple[int, ...]) -> DrawnFrames:
    """Distances, boxes and places of frames.

    Raises:
        ValueError: none of the first ones can be made.
    """
    places = {family.name: place for place, family in enumerate(recipe.families)}
    known: dict[int, tuple[Recipe, int, DrogueParameters, bool]] = {}
    drawn, scenes, rows, drops = list[int](), list[int](), list[Array](), list[Drop]()
    for frame_index in indices:
        scene_id = scene_of_frame(recipe, frame_index)
        try:
            if scene_id not in known:
                own = recipe_of_scene(recipe, scene_id)
                is_placed = not own.pose.on_axis and recipe.sequence is None
                known[scene_id] = own, places.get(own.family, 0), drogue_of_scene(own, scene_id), is_placed
            own, _, drogue, is_placed = known[scene_id]
            row = _row(own, frame_index, drogue, is_placed)
        except ValueError as error:
            drops.append(make_drop(frame_index, error))
            if not drawn and len(drops) >= min(FIRST_FRAMES, len(indices)):
                raise
            continue
        drawn.append(frame_index)
        scenes.append(scene_id)
        rows.append(row)
    values = np.array(rows).reshape(-1, _COLUMNS)
    return DrawnFrames(
        indices=tuple(drawn),
        scenes=np.array(scenes, dtype=np.int64),
        families=np.array([known[scene_id][1] for scene_id in scenes], dtype=np.int64),
        distances_m=values[:, 0],
        centers_px=values[:, 1:3],
        sides_px=values[:, 3],
        rooms_px=values[:, 4:],
        drops=tuple(drops),
    )


def _row(scene_recipe: Recipe, frame_index: int, drogue: DrogueParameters, is_placed: bool) -> Array:
    """(_COLUMNS,) distance [m], middle and side of the box, and room of its middle [px].

    Raises:
        ValueError: a pose that cannot be framed.
    """
    pose = left_from_drogue_in_scene(scene_recipe, drogue, frame_index)
    if pose is None:
        return np.full(_COLUMNS, np.nan)
    center_px, side_px, room_px = _box(drogue, scene_recipe.rig, pose)
    return np.array([pose.translation_m[2], *center_px, side_px, *(room_px if is_placed else np.full(4, np.nan))])


def _box(drogue: DrogueParameters, rig: StereoRig, pose: RigidTransform) -> tuple[Array, float, Array]:
    """Middle of the left image's full box [px], side of its square [px], and (4,) room of its middle [px]."""
    boxes = np.array([drogue_box(drogue, rig, pose, eye) for eye in EYES])
    low, size = boxes[:, :2], boxes[:, 2:]
    center = low[0] + size[0] / 2
    # A box shifts equally in both images until one leaves its image; lens distortion may move it further out.
    edge = rig.largest_shift_px() - 0.5
    limit = np.array([rig.camera.width_px, rig.camera.height_px]) - 1 - edge
    lowest, highest = center - (low.min(axis=0) - edge), center + (limit - (low + size).max(axis=0))
    return center, float(np.sqrt(size[0].prod())), np.stack([lowest, highest], axis=1).ravel()


@dataclass(frozen=True, eq=False)
class LawCheck:
    """Counts compared with a law.

    Attributes:
        counts, expected: by cell; (rows, columns) for places.
        statistic: Pearson's, for draws that need not have equal laws.
        degrees: of freedom; 0 where there are too few draws to say anything.
    """

    counts: Array
    expected: Array
    statistic: float
    degrees: int

    @property
    def p_value(self) -> float:
        """Probability of a statistic this large or larger if the law holds."""
        return float(chdtrc(self.degrees, self.statistic)) if self.degrees else 1.0


def check_sizes(drawn: DrawnFrames, recipe: Recipe) -> tuple[LawCheck, Array] | None:
    """Sizes of the boxes in bins of equal ratio, the first and the last open.

    Returns:
        The check, and the (SIZE_BINS + 1,) edges of the bins [px]; None without a drogue, with drogues of several
        sizes, or where distances are not drawn: at stations and in sequences.
    """
    shows, law = np.isfinite(drawn.distances_m), recipe.distance
    if law.law == "stations" or recipe.sequence is not None or not shows.any() or law.low_m == law.high_m:
        return None
    if len({drogue.rim_radius_m for drogue in recipe.drogues}) > 1:
        return None
    assert law.low_m is not None and law.high_m is not None
    sides_px = drawn.sides_px[shows]
    # The mean effect of attitude and lenses on the size; it moves draws over a bin's edge equally in both directions.
    side_at_1_m = float(np.exp(np.log(sides_px * drawn.distances_m[shows]).mean()))
    edges = np.geomspace(side_at_1_m / law.high_m, side_at_1_m / law.low_m, SIZE_BINS + 1)
    shares = np.diff(1.0 - distance_share(law, side_at_1_m / edges))
    places = np.clip(np.searchsorted(edges, sides_px, side="right") - 1, 0, SIZE_BINS - 1)
    return chi_square(np.eye(SIZE_BINS)[places], np.tile(shares, (len(places), 1))), edges


def distance_share(law: DistanceLaw, distance_m: Array) -> Array:
    """Share of a law's distances that are nearer than given ones; not for stations."""
    assert law.low_m is not None and law.high_m is not None
    edges, weights = np.array(law.edges_m or (law.low_m, law.high_m)), np.array(law.weights or (1.0,))
    ends = np.concatenate([[0.0], np.cumsum(weights) / weights.sum()])
    place = _cell(distance_m, edges)
    low, high = edges[place], edges[place + 1]
    if law.law == "uniform":
        share = (distance_m - low) / (high - low)
    elif law.law == "log-uniform":
        share = np.log(distance_m / low) / np.log(high / low)
    else:
        share = (1.0 / low - 1.0 / distance_m) / (1.0 / low - 1.0 / high)
    result: Array = ends[place] + np.clip(share, 0.0, 1.0) * (ends[place + 1] - ends[place])
    return result


def check_places(drawn: DrawnFrames, camera: PinholeCamera) -> LawCheck | None:
    """Middles of the boxes in equal cells of the left image; None where no place is drawn."""
    free = np.isfinite(drawn.rooms_px).all(axis=1)
    if not free.any():
        return None
    columns = np.linspace(-0.5, camera.width_px - 0.5, PLACE_COLUMNS + 1)
    rows = np.linspace(-0.5, camera.height_px - 0.5, PLACE_ROWS + 1)
    u, v = drawn.centers_px[free].T
    rooms = drawn.rooms_px[free]
    expected = np.einsum("nr,nc->nrc", _shares(rooms[:, 2:], rows), _shares(rooms[:, :2], columns))
    cells = _cell(v, rows) * PLACE_COLUMNS + _cell(u, columns)
    found = chi_square(np.eye(PLACE_ROWS * PLACE_COLUMNS)[cells], expected.reshape(len(cells), -1))
    shape = (PLACE_ROWS, PLACE_COLUMNS)
    return LawCheck(found.counts.reshape(shape), found.expected.reshape(shape), found.statistic, found.degrees)


def _shares(room: Array, edges: Array) -> Array:
    """(N, K) share of each (N, 2) interval in each cell between K + 1 edges."""
    low, high = room[:, :1], np.maximum(room[:, 1:], room[:, :1] + 1e-6)
    overlap = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    shares: Array = np.maximum(overlap, 0.0) / (high - low)
    return shares


def _cell(value: Array, edges: Array) -> Array:
    return np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)


def chi_square(hits: Array, laws: Array) -> LawCheck:
    """Pearson's chi-square test for draws that each follow a law of their own.

    With one law for all it is the textbook's sum of (count - expected)^2 / expected. Otherwise counts vary less than
    that sum takes them to, and their own covariance stands in its place. Cells in which few draws are expected count as
    one.

    Args:
        hits: (N, K) 1 in the cell in which a draw fell, 0 elsewhere.
        laws: (N, K) chances of each draw to fall into each cell.
    """
    counts, expected = hits.sum(axis=0), laws.sum(axis=0)
    rare = expected < _FEWEST_EXPECTED
    if rare.any() and not rare.all() and expected[rare].sum() < _FEWEST_EXPECTED:
        # Still too few together, so the smallest of the others joins them.
        rare[np.argmin(np.where(rare, np.inf, expected))] = True
    if rare.any():
        hits = np.column_stack([hits[:, ~rare], hits[:, rare].sum(axis=1)])
        laws = np.column_stack([laws[:, ~rare], laws[:, rare].sum(axis=1)])
    covariance = np.diag(laws.sum(axis=0)) - laws.T @ laws
    excess = hits.sum(axis=0) - laws.sum(axis=0)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _RANK_TOLERANCE * max(float(values[-1]), 1.0)
    statistic = float((np.square(vectors[:, kept].T @ excess) / values[kept]).sum())
    return LawCheck(counts, expected, statistic, int(kept.sum()))
