"""A recipe: what dataset to make. Read from TOML; every wrong key is named."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from datasets_manifest.environment_map import pin_map
from datasets_manifest.environment_ranges import EnvironmentRanges
from datasets_manifest.families import fill_families
from datasets_manifest.frame import Sensor
from datasets_manifest.json_types import FrozenModel, Rig
from datasets_manifest.ranges import Fraction, Range
from datasets_manifest.rigs import resolve_rig
from datasets_manifest.target_ranges import DrogueVariant, TargetRanges
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import explain, load_drogue

MAX_SEED = 2**63 - 1
_ENGINES_WITH_LENSES = ("analytic", "mitsuba")


class FrameCounts(FrozenModel):
    """How many pairs, over how many scenes, how many without a drogue."""

    count: int = Field(ge=1, le=10_000_000)
    scenes: int = Field(default=1, ge=1, le=1_000_000)
    empty_fraction: Fraction = 0.0


class DistanceLaw(FrozenModel):
    """How the distance of the rim centre along the optical axis is drawn.

    Attributes:
        law: `uniform`, `log-uniform`, `uniform-image-size` (uniform in 1/distance) between `low_m` and `high_m`, or
            `stations`, which frame by frame go through `stations_m`.
    """

    law: Literal["uniform", "log-uniform", "uniform-image-size", "stations"]
    low_m: float | None = Field(default=None, gt=0, le=1000)
    high_m: float | None = Field(default=None, gt=0, le=1000)
    stations_m: tuple[Annotated[float, Field(gt=0, le=1000)], ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.law == "stations":
            if self.stations_m is None or self.low_m is not None or self.high_m is not None:
                raise ValueError("stations_m: the law 'stations' takes stations_m, and neither low_m nor high_m")
        elif self.low_m is None or self.high_m is None or self.stations_m is not None:
            raise ValueError(f"low_m, high_m: the law '{self.law}' takes both, and no stations_m")
        elif self.low_m > self.high_m:
            raise ValueError(f"low_m: {self.low_m:g} is above high_m, {self.high_m:g}")
        return self

    @property
    def nearest_m(self) -> float:
        """Nearest distance that can be drawn. [m]"""
        return min(self.stations_m) if self.stations_m is not None else float(self.low_m or 0.0)


class Pose(FrozenModel):
    """Attitude of drogue and receiver, and the motion that blurs.

    Attributes:
        pitch_deg, yaw_deg, roll_deg: of the drogue in the camera.
        on_axis: the drogue's centre on the rig's axis instead of anywhere in the common field of view.
        camera_pitch_deg, camera_bank_deg: of the receiver against the horizon.
        speed_m_s: largest component of the drogue's velocity. [m/s]
        rate_deg_s: largest component of the angular velocities of drogue and receiver. [deg/s]
    """

    pitch_deg: Range = Range(low=-10, high=10)
    yaw_deg: Range = Range(low=-10, high=10)
    roll_deg: Range = Range(low=-22.5, high=22.5)
    on_axis: bool = False
    camera_pitch_deg: Range = Range(low=-4, high=4)
    camera_bank_deg: Range = Range(low=-5, high=5)
    speed_m_s: float = Field(default=0.0, ge=0, le=100)
    rate_deg_s: float = Field(default=0.0, ge=0, le=360)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.pitch_deg.within(-60, 60, "pitch_deg")
        self.yaw_deg.within(-60, 60, "yaw_deg")
        self.roll_deg.within(-180, 180, "roll_deg")
        self.camera_pitch_deg.within(-45, 45, "camera_pitch_deg")
        self.camera_bank_deg.within(-90, 90, "camera_bank_deg")
        return self


class ExposureLaw(FrozenModel):
    """How the exposure is set: by the meter, first with the time, then, when that is at its limit, with the gain.

    Attributes:
        time_s: fixed exposure time; without it the meter chooses within `auto_time_s`. [s]
        auto_gain: what the meter may amplify by; a single number is a fixed gain.
        auto_level_fraction: where the meter puts the brighter of sky and a white plate facing the camera, as a share of
            the full well, or at other gains of what fills the converter.
    """

    time_s: float | None = Field(default=None, gt=0, le=1)
    auto_time_s: Range = Range(low=20e-6, high=20e-3)
    auto_gain: Range = Range(low=1, high=1)
    auto_level_fraction: float = Field(default=0.7, gt=0, le=2)
    f_number: float = Field(default=2.8, ge=0.5, le=64)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.auto_time_s.within(1e-6, 1, "auto_time_s")
        self.auto_gain.within(0.1, 64, "auto_gain")
        return self


class RenderSettings(FrozenModel):
    """How the engine works.

    Attributes:
        engine: its name.
        samples_per_px: paths through each pixel of the drogue, but for those of the next two.
        open_samples_per_px: the same inside markers, face and rim, where hardly anything hides the sky.
        edge_samples_per_px: rays to the surfaces in each pixel where parts or shadows meet, and paths through each
            pixel on hub and coupling; `samples_per_px` if that is more.
        surround_samples_per_px: the same for hose and tanker.
        max_depth: longest path, counted in segments.
    """

    engine: str = Field(default="mitsuba", min_length=1, max_length=40)
    samples_per_px: int = Field(default=16, ge=1, le=65536)
    open_samples_per_px: int = Field(default=4, ge=1, le=65536)
    edge_samples_per_px: int = Field(default=64, ge=1, le=65536)
    surround_samples_per_px: int = Field(default=4, ge=1, le=65536)
    max_depth: int = Field(default=4, ge=2, le=64)


class Outputs(FrozenModel):
    """What is stored besides images, part ids and records."""

    exr: bool = False


class Split(FrozenModel):
    """Shares of the scenes in each split."""

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
    """Conditions of a share of a recipe's scenes.

    Attributes:
        name: written into the scenes' frames.
        weight: its share of the scenes, against the other families' weights.
        pose, target, environment, exposure: as in `Recipe`; in TOML only the keys that differ from the recipe's.
    """

    name: str = Field(min_length=1, max_length=40, pattern=r"^[a-z0-9][a-z0-9-]*$")
    weight: float = Field(default=1.0, gt=0, le=1e6)
    pose: Pose = Pose()
    target: TargetRanges = TargetRanges()
    environment: EnvironmentRanges = EnvironmentRanges()
    exposure: ExposureLaw = ExposureLaw()


class Recipe(FrozenModel):
    """What dataset to make, with every reference to presets and files replaced by its contents.

    Attributes:
        name: of the dataset.
        family: what kind of conditions, for tables; of recipes without `families`.
        seed: of everything random.
        drogue, rig, sensor: in TOML names of presets (`drogue` also a TOML file).
        families: over which the scenes are spread, each with its own conditions; or none.
    """

    name: str = Field(min_length=1, max_length=80, pattern=r"^[a-z0-9][a-z0-9-]*$")
    description: str = Field(default="", max_length=2000)
    family: str = Field(default="clear", min_length=1, max_length=40)
    seed: int = Field(default=1, ge=0, le=MAX_SEED)
    frames: FrameCounts
    drogue: DrogueParameters
    rig: Rig
    sensor: Sensor
    distance: DistanceLaw
    pose: Pose = Pose()
    target: TargetRanges = TargetRanges()
    environment: EnvironmentRanges = EnvironmentRanges()
    exposure: ExposureLaw = ExposureLaw()
    render: RenderSettings = RenderSettings()
    outputs: Outputs = Outputs()
    split: Split = Split()
    families: tuple[Family, ...] = Field(default=(), max_length=100)

    @property
    def variants(self) -> tuple[DrogueVariant, ...]:
        """All drogues of all families that scenes may have instead of the recipe's own."""
        targets = [family.target for family in self.families] or [self.target]
        return tuple(variant for target in targets for variant in target.variants)

    @model_validator(mode="after")
    def _families_differ(self) -> Self:
        names = [family.name for family in self.families]
        if len(set(names)) < len(names):
            raise ValueError(f"families: each needs a name of its own, got {', '.join(names)}")
        return self

    @model_validator(mode="after")
    def _engine_knows_lenses(self) -> Self:
        if self.rig.lenses is not None and self.render.engine not in _ENGINES_WITH_LENSES:
            raise ValueError(
                f"render.engine: {self.render.engine} draws ideal eyes only, and the rig has real lenses; use "
                f"{' or '.join(_ENGINES_WITH_LENSES)}, or a rig without eyes"
            )
        return self

    @model_validator(mode="after")
    def _nearest_distance_is_visible(self) -> Self:
        nearest = self.distance.nearest_m
        drogues = [variant.drogue for variant in self.variants] or [self.drogue]
        limit = max(self.rig.nearest_full_view_m(drogue.rim_radius_m) for drogue in drogues)
        if nearest < limit:
            raise ValueError(
                f"distance: {nearest:g} m is nearer than {limit:.2f} m, where the whole drogue fits both views"
            )
        return self


def recipe_names() -> list[str]:
    """Names of the recipes that ship."""
    folder = files("datasets_manifest") / "recipes"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_recipe(name_or_path: str, seed: int | None = None) -> tuple[Recipe, str]:
    """A recipe by the name of a shipped one, or from a TOML file.

    Args:
        name_or_path: name, or path of a `.toml` file.
        seed: replaces the recipe's own.

    Returns:
        The recipe with all references resolved, and its text as given.

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
                f"recipe: no {name_or_path!r} ships; there are {', '.join(recipe_names())}, or give a .toml file"
            )
        base = path.parent
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: cannot be read: {error}") from error
    try:
        return parse_recipe(text, base, seed), text
    except ValueError as error:
        raise ValueError(f"recipe {name_or_path}: {error}") from error


def parse_recipe(text: str, base: Path | None = None, seed: int | None = None) -> Recipe:
    """A recipe from TOML text; relative paths in it are read against `base`.

    Raises:
        ValueError: not TOML, or keys are wrong; names each key.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not valid TOML: {error}") from error
    if seed is not None:
        table["seed"] = seed
    drogue = table.get("drogue", "red-8")
    if not isinstance(drogue, str):
        raise ValueError("drogue: must be the name of a preset or a .toml file")
    table["drogue"] = load_drogue(drogue, base)
    fill_families(table)
    for part in (table, *table.get("families", ())):
        _load_variants(part.get("target"), base)
        if isinstance(part.get("environment"), dict):
            pin_map(part["environment"], base or Path())
    if "sensor" in table:
        raise ValueError("sensor: unknown key; it belongs to rig")
    table["rig"], table["sensor"] = resolve_rig(table.get("rig", "rgb-ideal"), _seed(table))
    try:
        return Recipe.model_validate(table)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


def _load_variants(target: object, base: Path | None) -> None:
    """Replace the names of drogues in `target.variants` by their contents; other types are left to the schema."""
    variants = target.get("variants") if isinstance(target, dict) else None
    for variant in variants if isinstance(variants, list) else ():
        if isinstance(variant, dict) and isinstance(variant.get("drogue"), str):
            variant["drogue"] = load_drogue(variant["drogue"], base)


def _seed(table: dict[str, Any]) -> int:
    """The seed of a recipe's table; a wrong one, which the schema will name, counts as none."""
    seed = table.get("seed", Recipe.model_fields["seed"].default)
    return seed if type(seed) is int and 0 <= seed <= MAX_SEED else 0
