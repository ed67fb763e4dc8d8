"""A recipe, which describes the dataset to make; read from TOML, with errors that name every wrong key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationError, model_validator

from datasets_manifest.random_streams import stream_seed
from datasets_manifest.recipe.aircraft_ranges import HoseRanges, NeighbourRanges, ReceiverRanges, TankerRanges
from datasets_manifest.recipe.camera_ranges import CameraRanges
from datasets_manifest.recipe.drogue_ranges import AppearanceRanges, DistanceLaw, DrogueVariant, PoseRanges
from datasets_manifest.recipe.environment_ranges import EnvironmentRanges
from datasets_manifest.recipe.rigs import ExposureLaw, Rangefinder, load_rig, resolve_rig
from datasets_manifest.recipe.sequence_ranges import SequenceRanges, check_single_frame_keys, fill_distance
from datasets_manifest.types.appearance import CalibrationBoard
from datasets_manifest.types.environment import pin_environment_map
from datasets_manifest.types.field_types import Fraction, Rig
from datasets_manifest.types.frame import Sensor
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import explain, load_drogue
from drogue_models.untrusted_files import parse_toml, read_text
from geometry.distortion import OpenCvDistortion

_FAMILY_SECTIONS = ("pose", "target", "environment", "exposure")
# Sections that a recipe may lack.
_OPTIONAL_FAMILY_SECTIONS = ("tanker", "hose", "receiver", "neighbours", "camera")


def fill_families(table: dict[str, Any]) -> None:
    """Complete each of a recipe's `[[families]]`, in place, with the recipe's values for the keys that it leaves out.

    Raises:
        ValueError: they are not an array of tables.
    """
    families = table.get("families", [])
    if not isinstance(families, list) or not all(isinstance(family, dict) for family in families):
        raise ValueError("families: must be tables, each begun by [[families]]")
    for family in families:
        optional = (name for name in _OPTIONAL_FAMILY_SECTIONS if name in table or name in family)
        for section in (*_FAMILY_SECTIONS, *optional):
            common, own = table.get(section, {}), family.get(section, {})
            if isinstance(common, dict) and isinstance(own, dict):
                family[section] = {**deepcopy(common), **own}


NAME_PATTERN = r"^[a-z0-9][a-z0-9-]*$"
MAX_SEED = 2**63 - 1
_ENGINES_WITH_LENSES = ("analytic", "mitsuba", "blender")


class FrameCounts(FrozenModel):
    """Numbers of pairs and scenes, and the share of pairs without a drogue.

    Attributes:
        count: number of pairs.
        scenes: number of scenes, among which the pairs are shared; each has its own sky, ground, tanker and drogue.
        empty_fraction: share of the pairs that show no drogue.
        stream: what keys the random streams beside the seed: recipes with two of them draw independently. In TOML the
            recipe's name by default; empty for the seed alone, as in datasets from before there was this key.
        in_turn: whether scenes go through families and drogue variants in the given order, so that a few sequences have
            every combination: the family changes from scene to scene, the variant after a round of families. Otherwise
            they are drawn at random.
    """

    count: int = Field(ge=1, le=10_000_000)
    scenes: int = Field(default=1, ge=1, le=1_000_000)
    empty_fraction: Fraction = 0.0
    stream: str = Field(default="", max_length=80, exclude_if=lambda stream: not stream)
    # Left out at its default, so that the hashes of other recipes stay those of earlier versions.
    in_turn: bool = Field(default=False, exclude_if=lambda in_turn: not in_turn)


class RenderSettings(FrozenModel):
    """Settings of the rendering engine.

    Attributes:
        engine: its name.
        samples_per_px: paths through each pixel of the drogue, except where the next two apply.
        open_samples_per_px: the same inside markers, face and rim, where little hides the sky.
        edge_samples_per_px: rays to the surfaces in each pixel with an edge of a part or shadow, and paths through each
            pixel of hub and coupling; at least `samples_per_px`.
        surround_samples_per_px: paths through each pixel of hose and tanker.
        max_depth: longest path, counted in segments.
        denoise: whether indirect light on a matt drogue and its surroundings is smoothed over each surface (engine
            mitsuba). Paths then start from pixel centres: `samples_per_px` where the smoothing is wide, up to
            `edge_samples_per_px` where the drogue is far away. Interiors take `open_samples_per_px` rays where paint
            varies and a fourth of them elsewhere, edges 16 to `edge_samples_per_px` on average: fewer with more
            interior pixels, more with higher contrast.
        noise_over_sensor: target of `denoise`: the renderer's noise on the drogue over the sensor's own. Edges take no
            more rays than it needs. Indirect light takes up to 16 times the paths where its variance alone would reach
            three quarters of the target's.
    """

    engine: str = Field(default="mitsuba", min_length=1, max_length=40)
    samples_per_px: int = Field(default=16, ge=1, le=65536)
    open_samples_per_px: int = Field(default=4, ge=1, le=65536)
    edge_samples_per_px: int = Field(default=324, ge=1, le=65536)
    surround_samples_per_px: int = Field(default=4, ge=1, le=65536)
    max_depth: int = Field(default=4, ge=2, le=64)
    denoise: bool = True
    noise_over_sensor: float = Field(default=0.42, gt=0, le=100, exclude_if=lambda noise: noise == 0.42)


class Outputs(FrozenModel):
    """Optional files besides images, part ids and records.

    Attributes:
        exr: whether every pair has EXR files of radiance, depth, normals and part ids.
    """

    exr: bool = False


class Split(FrozenModel):
    """Shares of the scenes in each split.

    Attributes:
        train, val, test: shares of the scenes; they add up to 1.
    """

    train: Fraction = 1.0
    val: Fraction = 0.0
    test: Fraction = 0.0

    @model_validator(mode="after")
    def _sum(self) -> Self:
        total = self.train + self.val + self.test
        if abs(total - 1) > 1e-9:
            raise ValueError(f"train, val, test: must add up to 1, got {total:g}")
        return self


class Family(FrozenModel):
    """A family of conditions, which a share of a recipe's scenes has.

    Attributes:
        name: stored in the frames of its scenes.
        weight: its share of the scenes, relative to the other families' weights.
        pose, target, environment, exposure, tanker, hose, receiver, neighbours, camera: as in `Recipe`; in TOML only
            the keys that differ from the recipe's.
    """

    name: str = Field(min_length=1, max_length=40, pattern=NAME_PATTERN)
    weight: float = Field(default=1.0, gt=0, le=1e6)
    pose: PoseRanges = PoseRanges()
    target: AppearanceRanges = AppearanceRanges()
    environment: EnvironmentRanges = EnvironmentRanges()
    exposure: ExposureLaw = ExposureLaw()
    tanker: TankerRanges | None = Field(default=None, exclude_if=lambda tanker: tanker is None)
    hose: HoseRanges | None = Field(default=None, exclude_if=lambda hose: hose is None)
    receiver: ReceiverRanges | None = Field(default=None, exclude_if=lambda receiver: receiver is None)
    neighbours: NeighbourRanges | None = Field(default=None, exclude_if=lambda neighbours: neighbours is None)
    camera: CameraRanges | None = Field(default=None, exclude_if=lambda camera: camera is None)


class Recipe(FrozenModel):
    """A dataset to make, with every reference to presets and files replaced by its contents.

    Attributes:
        name: of the dataset.
        description: for people; the dataset's card has it.
        family: name of the conditions, for tables, in recipes without `families`.
        seed: of all random streams, together with `frames.stream`.
        drogue, rig, sensor: in TOML names of presets (`drogue` also a TOML file).
        board: a calibration board that every frame shows instead of a drogue, or none; `distance` and `pose` then apply
            to its centre.
        rangefinder: simulated rangefinder with readings in the records, or none.
        families: of conditions, over which the scenes are distributed; or none.
        sequence: motion of the sequences; without it all pairs are independent.
        tanker: types and paints of the tankers, or none for a wing with one pod.
        hose: length, hang and paint of the hoses, or none for one length in the drogue's paint.
        receiver: its probe, and what else of it is in view, or none for what `target.probe` says.
        neighbours: other drogues in view, or none.
        camera: flaws, processing and coding of the pictures, or none for the sensor's own.
    """

    name: str = Field(min_length=1, max_length=80, pattern=NAME_PATTERN)
    description: str = Field(default="", max_length=2000)
    family: str = Field(default="clear", min_length=1, max_length=40)
    seed: int = Field(default=1, ge=0, le=MAX_SEED)
    frames: FrameCounts
    drogue: DrogueParameters
    rig: Rig
    sensor: Sensor
    distance: DistanceLaw
    pose: PoseRanges = PoseRanges()
    target: AppearanceRanges = AppearanceRanges()
    environment: EnvironmentRanges = EnvironmentRanges()
    exposure: ExposureLaw = ExposureLaw()
    render: RenderSettings = RenderSettings()
    outputs: Outputs = Outputs()
    split: Split = Split()
    board: CalibrationBoard | None = Field(default=None, exclude_if=lambda board: board is None)
    rangefinder: Rangefinder | None = Field(default=None, exclude_if=lambda rangefinder: rangefinder is None)
    families: tuple[Family, ...] = Field(default=(), max_length=100)
    sequence: SequenceRanges | None = Field(default=None, exclude_if=lambda sequence: sequence is None)
    tanker: TankerRanges | None = Field(default=None, exclude_if=lambda tanker: tanker is None)
    hose: HoseRanges | None = Field(default=None, exclude_if=lambda hose: hose is None)
    receiver: ReceiverRanges | None = Field(default=None, exclude_if=lambda receiver: receiver is None)
    neighbours: NeighbourRanges | None = Field(default=None, exclude_if=lambda neighbours: neighbours is None)
    camera: CameraRanges | None = Field(default=None, exclude_if=lambda camera: camera is None)

    @property
    def stream_seed(self) -> int:
        """Seed of all random streams of scenes and frames."""
        return stream_seed(self.seed, self.frames.stream) if self.frames.stream else self.seed

    @property
    def variants(self) -> tuple[DrogueVariant, ...]:
        """The drogue variants of all families; empty where every scene has the recipe's own drogue."""
        targets = [family.target for family in self.families] or [self.target]
        return tuple(variant for target in targets for variant in target.variants)

    @property
    def drogues(self) -> tuple[DrogueParameters, ...]:
        """The different drogues of frames: of each family its variants, or the recipe's own where it has none."""
        targets = [family.target for family in self.families] or [self.target]
        shown = (each for target in targets for each in ([v.drogue for v in target.variants] or [self.drogue]))
        return tuple(dict.fromkeys(shown))

    @model_validator(mode="after")
    def _families_differ(self) -> Self:
        names = [family.name for family in self.families]
        if len(set(names)) < len(names):
            raise ValueError(f"families: each needs a name of its own, got {', '.join(names)}")
        if self.frames.in_turn and len({family.weight for family in self.families}) > 1:
            raise ValueError("families: have equal weights where frames.in_turn is true; leave weight out")
        for part in self.families or (self,):
            if self.frames.in_turn and len({variant.weight for variant in part.target.variants}) > 1:
                raise ValueError("target.variants: have equal weights where frames.in_turn is true; leave weight out")
        return self

    @model_validator(mode="after")
    def _engine_knows_lenses(self) -> Self:
        if self.rig.lenses is not None and self.render.engine not in _ENGINES_WITH_LENSES:
            raise ValueError(
                f"render.engine: {self.render.engine} draws ideal eyes only, and the rig has real lenses; use "
                f"{' or '.join(_ENGINES_WITH_LENSES)}, or a rig without lenses"
            )
        has_long_models = any(isinstance(lens.distortion, OpenCvDistortion) for lens in self.rig.lenses or ())
        if has_long_models and self.render.engine == "blender":
            raise ValueError(
                "render.engine: blender draws lenses with k1, k2, p1, p2 and k3, and the rig's have more coefficients; "
                "use mitsuba or analytic"
            )
        return self

    @model_validator(mode="after")
    def _engine_draws_wear(self) -> Self:
        targets = self.target, *(family.target for family in self.families)
        if any(target.wear is not None for target in targets) and self.render.engine == "analytic":
            raise ValueError("target.wear: analytic draws even paint only; set render.engine to mitsuba or blender")
        return self

    @model_validator(mode="after")
    def _engine_draws_the_drogues(self) -> Self:
        bodies = sorted({drogue.name for drogue in self.drogues if drogue.body is not None})
        if bodies and self.render.engine == "analytic" and self.board is None:
            raise ValueError(
                f"render.engine: analytic draws flat rings only, not {', '.join(bodies)}; use mitsuba or blender"
            )
        return self

    @model_validator(mode="after")
    def _board_can_be_drawn(self) -> Self:
        if self.board is None:
            return self
        if self.render.engine != "analytic":
            raise ValueError(f"board: is drawn by the engine analytic only, got render.engine {self.render.engine!r}")
        if self.frames.empty_fraction != 1 or self.families:
            raise ValueError("board: takes the drogue's place; set frames.empty_fraction to 1, and give no families")
        if self.pose.speed_m_s != 0 or self.pose.rate_deg_s != 0:
            raise ValueError("board: stands still; set pose.speed_m_s and pose.rate_deg_s to 0")
        return self

    @model_validator(mode="after")
    def _pictures_are_of_one_kind(self) -> Self:
        parts: tuple[Recipe | Family, ...] = (self, *self.families)
        if any(part.camera is not None for part in parts) and (
            self.sensor.encoding != "gamma" or self.sensor.output_bits != 8
        ):
            raise ValueError(
                'camera: gives pictures of 8 bits for screens; set rig.encoding to "gamma" and rig.output_bits to 8, '
                f"got {self.sensor.encoding} and {self.sensor.output_bits}"
            )
        if self.sensor.color == "bayer" and any(
            part.camera.grey_scene_fraction + part.camera.near_infrared_scene_fraction > 0
            for part in parts
            if part.camera is not None
        ):
            raise ValueError(
                "camera: grey and near-infrared cameras have no mosaic, which the rig delivers; set "
                "camera.grey_scene_fraction and camera.near_infrared_scene_fraction to 0, or take another rig"
            )
        return self

    @model_validator(mode="after")
    def _tankers_can_be_drawn(self) -> Self:
        tankers = [part.tanker for part in self.families or (self,) if part.tanker is not None]
        if tankers and self.render.engine == "analytic":
            raise ValueError("tanker: the engine analytic draws none; leave it out, or use mitsuba or blender")
        if self.sequence is not None:
            for tanker in tankers:
                tanker.check_hose(self.sequence.hose.length_m)
        return self

    @model_validator(mode="after")
    def _surroundings_can_be_drawn(self) -> Self:
        parts: tuple[Recipe | Family, ...] = (self, *self.families)
        for part in parts:
            sections = {"hose": part.hose, "receiver": part.receiver, "neighbours": part.neighbours}
            for name, section in sections.items():
                if section is not None and self.render.engine == "analytic":
                    raise ValueError(f"{name}: the engine analytic draws none; leave it out, or use mitsuba or blender")
            if part.neighbours is not None and self.sequence is not None:
                raise ValueError("neighbours: are drawn in single frames only; leave them out with [sequence]")
            if part.receiver is not None and part.target.probe:
                raise ValueError("target.probe: draws a second probe beside that of [receiver]; leave it out")
        return self

    @model_validator(mode="after")
    def _sequences_move_by_themselves(self) -> Self:
        if self.sequence is None:
            return self
        if self.frames.empty_fraction > 0:
            raise ValueError("frames.empty_fraction: must be 0 with [sequence], where every pair has the drogue")
        dropouts = self.sequence.losses
        if dropouts is not None and "occlusion" in dropouts.kinds and self.render.engine == "analytic":
            raise ValueError(
                "render.engine: analytic draws no obstacles, and sequence.losses has occlusion; use mitsuba"
            )
        for part in self.families or (self,):
            check_single_frame_keys(part.pose, part.target)
            if part.hose is not None:
                part.hose.check_sequence()
            if dropouts is not None:
                dropouts.check_sun(part.pose, part.environment)
            longest_s = part.exposure.auto_time_s.high if part.exposure.time_s is None else part.exposure.time_s
            period_s = 1 / self.sequence.frame_rate_hz
            if longest_s > period_s:
                raise ValueError(
                    f"exposure: up to {longest_s:g} s are longer than the {period_s:g} s between pairs of the "
                    "sequence; lower time_s or auto_time_s, or frame_rate_hz"
                )
        return self

    @model_validator(mode="after")
    def _nearest_distance_is_visible(self) -> Self:
        nearest = self.distance.nearest_m
        if self.board is not None:
            limit = self.rig.nearest_plate_view_m(*self.board.size_m)
            if nearest < limit:
                raise ValueError(
                    f"distance: {nearest:g} m is nearer than {limit:.2f} m, where both views hold the board"
                )
            return self
        if self.sequence is not None:
            self.sequence.check_view(self.rig, max(drogue.rim_radius_m for drogue in self.drogues))
            return self
        limit = max(self.rig.nearest_full_view_m(drogue.rim_radius_m) for drogue in self.drogues)
        if nearest < limit:
            raise ValueError(
                f"distance: {nearest:g} m is nearer than {math.ceil(100 * limit) / 100:.2f} m, where the whole drogue "
                "fits both views"
            )
        return self


@dataclass(frozen=True)
class RecipeSource:
    """A recipe and the text that it was read from.

    Attributes:
        recipe: with every reference to presets and files resolved.
        text: TOML as the user gave it; a dataset keeps it beside the resolved recipe.
    """

    recipe: Recipe
    text: str


def recipe_names() -> list[str]:
    """Names of the shipped recipes."""
    folder = files("datasets_manifest") / "recipes"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_recipe(name_or_path: str, seed: int | None = None, changes: Mapping[str, Any] | None = None) -> RecipeSource:
    """A recipe by the name of a shipped one, or from a TOML file.

    Args:
        name_or_path: name, or path of a `.toml` file.
        seed: replaces the recipe's own.
        changes: see `parse_recipe`; the text of the result stays that of the file.

    Raises:
        ValueError: there is no such recipe, or keys are wrong; names each key.
    """
    if name_or_path in recipe_names():
        text = (files("datasets_manifest") / "recipes" / f"{name_or_path}.toml").read_text(encoding="utf-8")
        base = Path()
    else:
        path = Path(name_or_path)
        if path.suffix != ".toml":
            raise ValueError(
                f"recipe: no shipped recipe is named {name_or_path!r}; there are {', '.join(recipe_names())}, "
                "or give a .toml file"
            )
        base = path.parent
        try:
            text = read_text(path)
        except OSError as error:
            raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: not valid TOML: {error}") from error
    try:
        return RecipeSource(parse_recipe(text, base, seed, changes), text)
    except ValueError as error:
        raise ValueError(f"recipe {name_or_path}: {error}") from error


def parse_recipe(
    text: str, base: Path | None = None, seed: int | None = None, changes: Mapping[str, Any] | None = None
) -> Recipe:
    """A recipe from TOML text; relative paths in it are read against `base`.

    Args:
        text: TOML.
        base: folder that relative paths start from.
        seed: replaces the text's own.
        changes: values in the place of those of the text, by key; a mapping changes the keys that it names and leaves
            the others of its section, unless it names the section's law, whose keys are its own.

    Raises:
        ValueError: not TOML, or keys are wrong; names each key.
    """
    table = _with_changes(parse_toml(text), changes or {})
    if seed is not None:
        table["seed"] = seed
    drogue = table.get("drogue", "red-8")
    if not isinstance(drogue, str):
        raise ValueError("drogue: must be the name of a preset or a .toml file")
    table["drogue"] = load_drogue(drogue, base)
    _fill_stream(table)
    fill_families(table)
    fill_distance(table)
    for part in (table, *table.get("families", ())):
        _load_variants(part.get("target"), base)
        if isinstance(part.get("environment"), dict):
            pin_environment_map(part["environment"], base or Path())
    if "sensor" in table:
        raise ValueError("sensor: unknown key; it belongs to rig")
    table["rig"], table["sensor"] = resolve_rig(load_rig(table.get("rig", "rgb-ideal"), base), _seed(table))
    try:
        return Recipe.model_validate(table)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


def _with_changes(table: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The table with values replaced, section by section."""
    changed = dict(table)
    for key, value in changes.items():
        before = changed.get(key)
        if isinstance(value, Mapping):
            kept = before if isinstance(before, dict) and "law" not in value else {}
            changed[key] = _with_changes(kept, value)
        else:
            changed[key] = value
    return changed


def _fill_stream(table: dict[str, Any]) -> None:
    """Key a recipe's random streams, in place, by its name where it names no others."""
    if isinstance(table.get("frames"), dict) and isinstance(table.get("name"), str):
        table["frames"] = {"stream": table["name"], **table["frames"]}


def _load_variants(target: object, base: Path | None) -> None:
    """Replace the names of drogues in `target.variants` by their contents; other types are left to the schema."""
    variants = target.get("variants") if isinstance(target, dict) else None
    for variant in variants if isinstance(variants, list) else ():
        if isinstance(variant, dict) and isinstance(variant.get("drogue"), str):
            variant["drogue"] = load_drogue(variant["drogue"], base)


def _seed(table: dict[str, Any]) -> int:
    """The seed of a recipe's table; 0 in place of a wrong one, which the schema then reports."""
    seed = table.get("seed", Recipe.model_fields["seed"].default)
    return seed if type(seed) is int and 0 <= seed <= MAX_SEED else 0
