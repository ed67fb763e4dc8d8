"""Commented files of a drogue, a rig and a recipe, to start from."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.recipe.rigs import read_rig_file, resolve_rig
from drogue_models.presets import explain, parse_drogue

# The face is as wide as leaves a margin of these many marker radii on either side of the markers.
_FACE_MARGIN, _TUBE_SHARE = 2.5, 0.016
_USUAL_SIZE = "1280x960"

_DROGUE = """# A drogue. Use it as `drogue = "{file}"` in a recipe, and look at it with
# `droguekit model {file} --out drogue.glb`.
# Lengths are in metres, reflectances from 0 to 1. docs/how-to/add-a-drogue.md tells of markers in no even ring and
# of bodies such as baskets, leaves and cones; drogue_models/parameters.py of every key.
name = "{name}"

# Outermost radius, radius of the face's opening, and radius of the tube around the rim.
rim_radius_m = {rim:.15g}
face_inner_radius_m = {inner:.15g}
rim_tube_radius_m = {tube:.15g}

# An even ring of markers. For any other layout write marker_positions_m = [[x, y], ...] instead of these two.
marker_count = {markers}
marker_ring_radius_m = {ring:.15g}
marker_radius_m = {radius:.15g}

# Lamps shine with this luminance [cd/m2], 0 stands for paint. By day a clear sky has 2000 to 10,000 cd/m2.
marker_luminance_cd_m2 = {luminance:.15g}
marker_emission_rgb = [1.0, 1.0, 1.0]
marker_reflectance_rgb = [0.8, 0.8, 0.8]

# Lamps that blink tell the roll of a ring: a pattern for each marker, 1 lit and 0 dark, and the length of a slot.
# [marker_code]
# slot_s = 0.04
# patterns = ["01", "1", "1", ...]
"""
_RIG = """# A stereo rig. Use it as `rig = "{file}"` in a recipe.
# The shipped rig to start from: its sensor's noise, responsivity and colour. docs/reference/conventions.md lists them.
preset = {preset}

{geometry}

# 8, or 12 in files of 16 bits, which most viewers show as black; `droguekit preview` shows them.
output_bits = {bits}

# This table replaces that of the preset: a key that is left out has its default.
[optics]
{optics}

{eyes}"""
_CALIBRATION = """# Cameras, lenses and baseline are those of this file of OpenCV, Kalibr, ROS, EuRoC or ORB-SLAM.
# Two files that belong together are ["left.yaml", "right.yaml"]. docs/how-to/calibrate.md tells more.
calibration = {files}
calibration_unit = {unit}"""
_SIZE = """# Size of an image.
width_px = {width}
height_px = {height}
"""
_GEOMETRY = """# Size of an image, focal length over pixel pitch, and distance of the cameras.
width_px = {width}
height_px = {height}
focal_px = {focal:.15g}
baseline_m = {baseline:.15g}"""
_EYES = """
# Real lenses: Brown-Conrady coefficients. Without this table the lenses are {lenses}.
# [eyes]
# k1 = -0.12
# k2 = 0.05
# p1 = 0.0003
# p2 = -0.0002
"""
_RECIPE = """# A recipe. `droguekit check {file}` predicts how well the markers can be measured,
# `droguekit plan {file}` how long it takes, and `droguekit render {file} --out data/{name}` makes it.
# docs/reference/recipe-keys.md explains every key.
name = "{name}"
drogue = {drogue}
rig = {rig}

[frames]
count = {pairs}
scenes = {scenes}

# Distance of the rim's centre: every doubling of the distance equally likely.
[distance]
law = "log-uniform"
low_m = {low:.15g}
high_m = {high:.15g}

# By day: elevation of the sun. -4 is dusk, -18 night.
[environment]
sun_elevation_deg = {{ low = 10.0, high = 60.0 }}

# `mitsuba` traces paths; `analytic` draws flat drogues quickly, without a path tracer.
[render]
engine = "mitsuba"
"""


@dataclass(frozen=True)
class FileChoices:
    """The numbers of a new file, as the command's options name them.

    Attributes:
        rim_radius_m, markers, marker_radius_m, luminance_cd_m2: of a drogue.
        preset, size, focal_px, baseline_m, bits: of a rig.
        calibration, calibration_unit: of a rig instead of focal length and baseline; its one or two files. The size is
            then only for files that lack it.
        drogue, rig, distance, pairs: of a recipe.
    """

    rim_radius_m: float = 0.305
    markers: int = 8
    marker_radius_m: float = 0.01
    luminance_cd_m2: float = 0.0
    preset: str = "mono"
    size: str | None = None
    focal_px: float = 2133.3
    baseline_m: float = 0.12
    bits: int = 8
    calibration: tuple[Path, ...] = ()
    calibration_unit: str = "m"
    drogue: str = "red-8"
    rig: str = "mono"
    distance: str = "5:40"
    pairs: int = 100


def write_new_file(kind: Literal["drogue", "rig", "recipe"], out: Path, choices: FileChoices) -> None:
    """Write a commented file, after checking that it can be used.

    Raises:
        ValueError: the file exists, or numbers that do not fit together; names the key.
        OSError: it cannot be written.
    """
    if out.suffix != ".toml" or not out.name.isprintable():
        raise ValueError(f"--out: must be a .toml file, got {out}")
    if out.exists():
        raise ValueError(f"--out: {out} is there already; name another file, or delete this one")
    text = {"drogue": _drogue_text, "rig": _rig_text, "recipe": _recipe_text}[kind](out, choices)
    if kind == "drogue":
        try:
            parse_drogue(text, out.parent)
        except ValidationError as error:
            raise ValueError(f"new drogue: {explain(error)}") from error
    elif kind == "rig":
        table = read_rig_file(text, str(out))
        if choices.calibration:
            # As the command names them: the new file's folder may not be there yet.
            table["calibration"] = [str(file) for file in choices.calibration]
        resolve_rig(table)
    else:
        out.parent.mkdir(parents=True, exist_ok=True)  # files are named as seen from there
        parse_recipe(text, out.parent)
    write_text_atomic(out, text)


def _name(out: Path) -> str:
    return "".join(each if each.isascii() and each.isalnum() else "-" for each in out.stem.lower()).strip("-") or "mine"


def _text(words: str) -> str:
    """A TOML string, which JSON writes alike."""
    return json.dumps(words, ensure_ascii=False)


def _file_or_name(choice: str, out: Path) -> str:
    """A TOML string of a preset's name, or of a file as seen from the folder of the new one."""
    is_file = choice.endswith(".toml") and not Path(choice).is_absolute()
    return _text(os.path.relpath(choice, out.parent) if is_file else choice)


def _drogue_text(out: Path, choices: FileChoices) -> str:
    rim, radius = choices.rim_radius_m, choices.marker_radius_m
    tube = round(_TUBE_SHARE * rim, 4)
    ring = rim - tube - _FACE_MARGIN * radius
    return _DROGUE.format(
        file=out.name,
        name=_name(out),
        rim=rim,
        inner=round(ring - _FACE_MARGIN * radius, 4),
        tube=tube,
        markers=choices.markers,
        ring=round(ring, 4),
        radius=radius,
        luminance=choices.luminance_cd_m2,
    )


def _rig_text(out: Path, choices: FileChoices) -> str:
    rig, sensor = resolve_rig(choices.preset)
    optics = sensor.optics.model_dump(exclude_defaults=True) | {"pixel_pitch_um": sensor.optics.pixel_pitch_um}
    lenses = "ideal" if rig.lenses is None else "those of the preset"
    return _RIG.format(
        file=out.name,
        preset=_text(choices.preset),
        geometry=_calibration_text(out, choices) if choices.calibration else _geometry_text(choices),
        bits=choices.bits,
        optics="\n".join(f"{key} = {json.dumps(value)}" for key, value in optics.items()),
        eyes="" if choices.calibration else _EYES.format(lenses=lenses),
    )


def _size_px(size: str) -> tuple[int, int]:
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ValueError(f"--size: must be WIDTHxHEIGHT in pixels, such as 1920x1200, got {size!r}")
    return int(width), int(height)


def _geometry_text(choices: FileChoices) -> str:
    width_px, height_px = _size_px(_USUAL_SIZE if choices.size is None else choices.size)
    return _GEOMETRY.format(width=width_px, height=height_px, focal=choices.focal_px, baseline=choices.baseline_m)


def _calibration_text(out: Path, choices: FileChoices) -> str:
    files = [str(file) if file.is_absolute() else os.path.relpath(file, out.parent) for file in choices.calibration]
    named = json.dumps(files if len(files) > 1 else files[0], ensure_ascii=False)
    text = _CALIBRATION.format(files=named, unit=_text(choices.calibration_unit))
    if choices.size is None:
        return text
    width_px, height_px = _size_px(choices.size)
    return f"{_SIZE.format(width=width_px, height=height_px)}\n{text}"


def _recipe_text(out: Path, choices: FileChoices) -> str:
    low, _, high = choices.distance.partition(":")
    try:
        low_m, high_m = float(low), float(high)
    except ValueError as error:
        raise ValueError(f"--distance: must be NEAR:FAR in metres, such as 5:60, got {choices.distance!r}") from error
    return _RECIPE.format(
        file=out.name,
        name=_name(out),
        drogue=_file_or_name(choices.drogue, out),
        rig=_file_or_name(choices.rig, out),
        pairs=choices.pairs,
        scenes=max(1, choices.pairs // 10),
        low=low_m,
        high=high_m,
    )
