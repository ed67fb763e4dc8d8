"""Cost of a stereo pair by each engine at equal noise."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from drogue_models.parts import drogue_part_ids
from geometry.stereo import EYES
from render.engine import RenderEngine, StereoRadiance
from scenes.sky.photometry import luminance
from studies.engine_agreement.measures import eye_radiance
from studies.engine_agreement.paired_frames import frame_at, recipe_of_family

COST_STATIONS_M = (40.0, 20.0, 10.0, 5.0, 2.0)
COST_FAMILY = "demo"
# Even squares, tried in turn: on edges noise falls faster than any law by which it could be extrapolated.
_SAMPLES = (16, 64, 144, 256, 400, 576)


@dataclass(frozen=True)
class EngineCost:
    """Cost of one pair by one engine.

    Attributes:
        samples: per pixel of the drogue.
        cpu_s: CPU time without sensor, labels and disk. [s]
        noise: root mean square error of luminance by sampling over its mean, on the pixels whose centres see the
            drogue, edges included.
    """

    samples: int
    cpu_s: float
    noise: float


@dataclass(frozen=True)
class CostComparison:
    """Both engines at one distance: the first with default samples, the second at the same noise or less.

    Attributes:
        distance_m: of the drogue. [m]
        one: first engine.
        other: second engine with the fewest samples tried that give no more noise, or with the most samples.
    """

    distance_m: float
    one: EngineCost
    other: EngineCost

    @property
    def is_reached(self) -> bool:
        """Whether the second engine reached the noise of the first."""
        return bool(self.other.noise <= self.one.noise)

    def row(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self) | {"is_reached": self.is_reached}


def cost_from_row(row: dict[str, Any]) -> CostComparison:
    """The comparison from its `CostComparison.row`."""
    return CostComparison(distance_m=row["distance_m"], one=EngineCost(**row["one"]), other=EngineCost(**row["other"]))


def measure_costs(distance_m: float, seed: int, one: RenderEngine, other: RenderEngine) -> CostComparison:
    """Render one frame by both engines, each twice with independent samples.

    Both engines must have rendered before, because the first picture of a process includes compilation.

    Args:
        distance_m: of the drogue. [m]
        seed: of the frame.
        one, other: engines.
    """
    first = _cost(distance_m, seed, one, RenderSettings().samples_per_px)
    for samples in _SAMPLES:
        second = _cost(distance_m, seed, other, samples)
        if second.noise <= first.noise:
            break
    return CostComparison(distance_m=distance_m, one=first, other=second)


def _cost(distance_m: float, seed: int, engine: RenderEngine, samples: int) -> EngineCost:
    frame = frame_at(recipe_of_family(COST_FAMILY, seed), distance_m, 1, 0)
    assert frame.drogue is not None
    settings = RenderSettings(engine=engine.name, samples_per_px=samples)
    pictures = [engine.render(frame.model_copy(update={"seed": seed + number}), settings) for number in range(2)]
    parts = drogue_part_ids(frame.drogue.marker_count)
    first, second = (_on_parts(picture, pictures[0], parts) for picture in pictures)
    return EngineCost(
        samples=samples,
        cpu_s=float(np.mean([sum(picture.stage_s.values()) for picture in pictures])),
        noise=float(np.sqrt(np.mean(np.square(first - second)) / 2) / np.mean((first + second) / 2)),
    )


def _on_parts(picture: StereoRadiance, where: StereoRadiance, parts: list[int]) -> NDArray[np.float64]:
    """Luminance of both eyes at the pixels where `where` shows the parts."""
    return np.concatenate(
        [
            luminance(eye_radiance(picture, eye).radiance_cd_m2[np.isin(eye_radiance(where, eye).part_id, parts)])
            for eye in EYES
        ]
    )
