"""A recipe whose sky is a picture, as a user's own would be: a drawn sky with its sun as one very bright spot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datasets_manifest.atomic import write_text_atomic
from scenes.environment_radiance import surroundings
from scenes.sampler import sample_frame
from studies.engine_agreement.paired_frames import recipe_of_family

_DRAWN_FROM, _SEED = "world-89/sea", 1
_HEIGHT_PX = 256
_RECIPE = """name = "own-sky"
seed = 1
rig = "rgb-ideal"

[frames]
count = 1

[distance]
law = "stations"
stations_m = [10.0]

[environment.map]
file = "sky.exr"
cd_m2_per_unit = 1.0
rotation_deg = [-180, 180]
"""


def write_own_sky(folder: Path) -> Path:
    """Write picture and recipe, if they are not there.

    Returns:
        The recipe's file.

    Raises:
        OSError: they cannot be written.
    """
    picture, recipe = folder / "sky.exr", folder / "own-sky.toml"
    if not recipe.exists():
        folder.mkdir(parents=True, exist_ok=True)
        channels = {name: np.ascontiguousarray(values) for name, values in zip("RGB", _picture(), strict=True)}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(str(picture))
        # Comes last and says that the picture is whole.
        write_text_atomic(recipe, _RECIPE)
    return recipe


def _picture() -> NDArray[np.float32]:
    """(3, H, 2H) radiance: top row the zenith, the middle column looks east, right of it is south. [cd/m2]"""
    around = surroundings(sample_frame(recipe_of_family(_DRAWN_FROM, _SEED), 0).environment)
    polar = (np.arange(_HEIGHT_PX) + 0.5) * np.pi / _HEIGHT_PX
    azimuth = np.pi - (np.arange(2 * _HEIGHT_PX) + 0.5) * np.pi / _HEIGHT_PX
    across, up = np.sin(polar)[:, None], np.broadcast_to(np.cos(polar)[:, None], (_HEIGHT_PX, 2 * _HEIGHT_PX))
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=-1)
    picture = around.radiance(directions.astype(np.float32)).astype(np.float32)
    row, column = np.unravel_index(int(np.argmax(directions @ around.beam_direction)), up.shape)
    solid_angle_sr = (np.pi / _HEIGHT_PX) ** 2 * np.sin(polar[row])
    picture[row, column] += (around.beam_illuminance_lux / solid_angle_sr).astype(np.float32)
    result: NDArray[np.float32] = np.moveaxis(picture, -1, 0)
    return result
