"""Operational design domains: ranges of conditions, cut into cells, and how many pairs a dataset needs in each.

A domain is a TOML file. Its `quantities` are numbers with edges between bins, or words with the values that count; its
`cells` name the quantities that are crossed, and the fewest pairs that every cell of the product needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple, Self, get_args

import numpy as np
from pydantic import Field, ValidationError, model_validator

from datasets_manifest.types.environment import GROUND_KINDS
from datasets_manifest.types.records import PairRecord
from datasets_manifest.types.video_camera import Spectrum
from drogue_models.bodies import BODY_FAMILIES
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.tankers.tanker import TankerType
from drogue_models.untrusted_files import parse_toml, read_text

SHIPPED = ("probe-and-drogue",)
"""Domains that come with droguekit, by name."""
MOST_CELLS = 10_000


def _box(record: PairRecord) -> tuple[float, float, float, float] | None:
    return record.views.left.box_full_xywh_px


def _box_side_px(record: PairRecord) -> float | None:
    box = _box(record)
    return None if box is None else math.sqrt(box[2] * box[3])


def _off_axis_fraction(record: PairRecord) -> float | None:
    box, camera = _box(record), record.frame.rig.camera
    if box is None:
        return None
    x, y, width, height = box
    middle_px = np.array([x + width / 2, y + height / 2])
    image_middle_px = np.array([camera.width_px - 1, camera.height_px - 1]) / 2
    return float(np.linalg.norm(middle_px - image_middle_px) / np.linalg.norm(image_middle_px))


def _image_motion_px(record: PairRecord) -> float | None:
    start, end = record.left_from_drogue_open, record.left_from_drogue_close
    if start is None or end is None:
        return None
    centers_m = np.array([start.translation_m, end.translation_m])
    if centers_m[:, 2].min() <= 0:
        return None
    first_px, last_px = record.frame.rig.image(centers_m, "left")
    return float(np.linalg.norm(last_px - first_px))


def _clouds(record: PairRecord) -> str:
    environment = record.frame.environment
    if environment.mist is not None:
        return "around"
    if not environment.clouds:
        return "none"
    return "above" if any(layer.height_above_camera_m > 0 for layer in environment.clouds) else "below"


def _drogue(record: PairRecord) -> str:
    drogue = record.frame.drogue
    if drogue is None:
        return "none"
    return "ring" if drogue.body is None else drogue.body.family


def _markers(record: PairRecord) -> str | None:
    drogue = record.frame.drogue
    return None if drogue is None else "some" if drogue.marker_count else "none"


def _tanker(record: PairRecord) -> str:
    frame = record.frame
    if frame.tanker is not None:
        return frame.tanker.type
    return "none" if frame.left_from_tanker is None else "wing"


NUMBERS: dict[str, Callable[[PairRecord], float | None]] = {
    "distance_m": lambda record: record.conditions.distance_m,
    "box_side_px": _box_side_px,
    "off_axis_fraction": _off_axis_fraction,
    "pitch_deg": lambda record: record.pitch_deg,
    "yaw_deg": lambda record: record.yaw_deg,
    "roll_deg": lambda record: record.roll_deg,
    "sun_elevation_deg": lambda record: record.conditions.sun_elevation_deg,
    "background_luminance_cd_m2": lambda record: record.conditions.background_luminance_cd_m2,
    "visibility_m": lambda record: record.frame.environment.visibility_m,
    "altitude_m": lambda record: record.frame.environment.altitude_m,
    "image_motion_px": _image_motion_px,
}
"""Numbers of a pair; None where they have no meaning, as a distance without a drogue."""
WORDS: dict[str, Callable[[PairRecord], str | None]] = {
    "family": lambda record: record.conditions.family,
    "drogue": _drogue,
    "markers": _markers,
    "tanker": _tanker,
    "clouds": _clouds,
    "ground": lambda record: record.frame.environment.ground,
    "camera": lambda record: "ideal" if record.frame.camera is None else record.frame.camera.spectrum,
    "sensor": lambda record: record.frame.sensor.name,
}
"""Words of a pair, likewise."""
CLOSED_WORDS: dict[str, tuple[str, ...]] = {
    "drogue": ("none", "ring", *BODY_FAMILIES),
    "markers": ("some", "none"),
    "tanker": ("none", "wing", *get_args(TankerType)),
    "clouds": ("none", "above", "below", "around"),
    "ground": GROUND_KINDS,
    "camera": ("ideal", *get_args(Spectrum)),
}
"""All words that there are; families and sensors have the names that a recipe gives them."""


def bin_names(edges: Sequence[float], fewest_digits: int) -> tuple[str, ...]:
    """A name for each bin, with as many digits as tell all edges apart."""
    texts: list[str] = []
    for digits in range(fewest_digits, 18):  # 17 tell all numbers apart
        texts = [f"{edge:.{digits}g}" for edge in edges]
        if len(set(texts)) == len(texts):
            break
    return tuple(f"{low} to {high}" for low, high in pairwise(texts))


class DomainQuantity(FrozenModel):
    """A condition, and how it is cut.

    Attributes:
        edges: ascending ends of the bins of a number, in the unit that its name ends with. A bin holds its lower end,
            the last one also its upper.
        values: words that count.
        source: where the edges or values come from.
    """

    edges: tuple[float, ...] | None = None
    values: tuple[str, ...] | None = None
    source: str = ""

    @model_validator(mode="after")
    def _has_bins(self) -> Self:
        if (self.edges is None) == (self.values is None):
            raise ValueError("needs either edges, for a number, or values, for words")
        if self.edges is not None and (len(self.edges) < 2 or any(low >= high for low, high in pairwise(self.edges))):
            raise ValueError("edges: must be at least two that ascend")
        if self.values is not None and (not self.values or len(set(self.values)) != len(self.values)):
            raise ValueError("values: must be different words, at least one")
        return self

    @property
    def bins(self) -> tuple[str, ...]:
        """Names of the bins."""
        if self.edges is not None:
            return bin_names(self.edges, fewest_digits=6)
        return self.values or ()


class Crossing(FrozenModel):
    """Quantities whose bins are crossed.

    Attributes:
        of: names of one to three quantities.
        fewest_pairs: that every cell needs; 0 only counts them.
    """

    of: tuple[str, ...] = Field(min_length=1, max_length=3)
    fewest_pairs: int = Field(default=1, ge=0)


class DesignDomain(FrozenModel):
    """Ranges of conditions and their cells.

    Attributes:
        name, description: for tables and pages.
        most_position_error_fraction: of the distance, up to which a pose counts as solved.
        quantities: by name, see `NUMBERS` and `WORDS`.
        cells: which of them are crossed.
    """

    name: str = Field(min_length=1, max_length=80)
    description: str = ""
    most_position_error_fraction: float = Field(default=0.01, gt=0, le=1)
    quantities: dict[str, DomainQuantity] = Field(min_length=1)
    cells: tuple[Crossing, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_exist(self) -> Self:
        for name, quantity in self.quantities.items():
            if name not in NUMBERS and name not in WORDS:
                raise ValueError(f"quantities.{name}: no such quantity; there are {', '.join([*NUMBERS, *WORDS])}")
            if (quantity.edges is not None) != (name in NUMBERS):
                raise ValueError(f"quantities.{name}: needs {'edges' if name in NUMBERS else 'values'}")
            known = CLOSED_WORDS.get(name, quantity.values or ())
            if unknown := [word for word in quantity.values or () if word not in known]:
                raise ValueError(
                    f"quantities.{name}: no such value: {', '.join(unknown)}; there are {', '.join(known)}"
                )
        for crossing in self.cells:
            for name in crossing.of:
                if name not in self.quantities:
                    raise ValueError(f"cells: {name!r} is none of the quantities")
            if len(set(crossing.of)) != len(crossing.of):
                raise ValueError(f"cells: {' x '.join(crossing.of)}: crosses a quantity with itself")
            count = math.prod(len(self.quantities[name].bins) for name in crossing.of)
            if count > MOST_CELLS:
                raise ValueError(f"cells: {' x '.join(crossing.of)}: {count} cells are more than {MOST_CELLS}")
        return self

    def cells_of(self, crossing: Crossing) -> list[tuple[str, ...]]:
        """All cells of a crossing, as names of their bins."""
        return list(product(*(self.quantities[name].bins for name in crossing.of)))

    def bins_of(self, record: PairRecord) -> dict[str, Placed]:
        """Where a pair lies in each quantity."""
        return {name: _placed(name, quantity, record) for name, quantity in self.quantities.items()}


class Placed(NamedTuple):
    """Where a pair lies in a quantity.

    Attributes:
        bin: name of the bin; None outside of all.
        applies: whether the quantity has a meaning for the pair.
    """

    bin: str | None
    applies: bool


def _placed(name: str, quantity: DomainQuantity, record: PairRecord) -> Placed:
    if quantity.edges is None:
        word = WORDS[name](record)
        return Placed(word if word in quantity.bins else None, word is not None)
    number = NUMBERS[name](record)
    if number is None:
        return Placed(None, False)
    edges = quantity.edges
    if not edges[0] <= number <= edges[-1]:
        return Placed(None, True)
    place = min(int(np.searchsorted(edges, number, side="right")), len(edges) - 1) - 1
    return Placed(quantity.bins[place], True)


def load_domain(name_or_path: str) -> DesignDomain:
    """A shipped domain by name, or one from a TOML file.

    Raises:
        ValueError: no such domain, or wrong keys; names them.
    """
    if name_or_path in SHIPPED:
        text = (files("droguekit.assurance") / "domains" / f"{name_or_path}.toml").read_text(encoding="utf-8")
        return DesignDomain.model_validate(parse_toml(text))
    if not name_or_path.endswith(".toml"):
        raise ValueError(
            f"--odd: no domain named {name_or_path!r}; there is {', '.join(SHIPPED)}, or give a .toml file"
        )
    path = Path(name_or_path)
    try:
        return DesignDomain.model_validate(parse_toml(read_text(path)))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
