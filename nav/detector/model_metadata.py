"""The metadata that a detector's ONNX file carries."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from drogue_models.untrusted_files import parse_json
from nav.detector.coarse_to_fine import LARGEST_SMALL_PX
from nav.detector.output_maps import MAX_SIDE_PX, SIZE_STEP_PX

METADATA_KEY = "droguekit_detector"
"""Key of the ONNX metadata under which the JSON of `ModelMetadata` is stored."""

_JSON_NAME: dict[type, str] = {str: "a text", Mapping: "an object"}


@dataclass(frozen=True)
class ModelMetadata:
    """Everything needed to use a network, and its provenance.

    Attributes:
        input_size_px: width and height of its input; multiples of 32.
        score_threshold: a box with a lower score is not a drogue.
        large_from_px: boxes whose longer side in the input is at least this come from a second pass at half the size;
            0 for a single pass. [px]
        small_below_px: boxes whose longer side in the input is below this are looked at again at twice the scale, see
            `nav.detector.coarse_to_fine`; 0 for never. [px]
        classes: exactly one name.
        licence: of the weights.
        manifest_sha256: of the dataset that it was trained on; empty for a dataset not made by droguekit, and for
            several, which `training` lists.
        network: its `NetworkConfig` as a dict; empty for a network that is not droguekit's.
        training: other facts of the training, as plain JSON.
    """

    input_size_px: tuple[int, int] = (640, 480)
    score_threshold: float = 0.5
    large_from_px: float = 0.0
    small_below_px: float = 0.0
    classes: tuple[str, ...] = ("drogue",)
    licence: str = ""
    manifest_sha256: str = ""
    network: Mapping[str, str] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sides = self.input_size_px
        if len(sides) != 2 or any(type(side) is not int or side < 1 or side % SIZE_STEP_PX for side in sides):
            raise ValueError(f"input_size_px: must be two multiples of {SIZE_STEP_PX}, got {sides!r}")
        if max(sides) > MAX_SIDE_PX:
            raise ValueError(f"input_size_px: must be at most {MAX_SIDE_PX} a side, got {sides!r}")
        # In Python a bool is an int.
        if type(self.score_threshold) not in (int, float) or not 0 <= self.score_threshold <= 1:
            raise ValueError(f"score_threshold: must be 0 to 1, got {self.score_threshold!r}")
        for name, most in (("large_from_px", MAX_SIDE_PX), ("small_below_px", LARGEST_SMALL_PX)):
            side = getattr(self, name)
            if type(side) not in (int, float) or not 0 <= side <= most:
                raise ValueError(f"{name}: must be 0 to {most}, got {side!r}")
        if len(self.classes) != 1 or not all(isinstance(name, str) for name in self.classes):
            raise ValueError(f"classes: must be one name, got {self.classes!r}")
        for name, kind in (("licence", str), ("manifest_sha256", str), ("network", Mapping), ("training", Mapping)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name}: must be {_JSON_NAME[kind]}, got {getattr(self, name)!r}")

    def to_json(self) -> str:
        """The JSON text that `from_json` reads."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> ModelMetadata:
        """The metadata in a JSON text.

        Raises:
            ValueError: it is not a JSON object with these keys, or a value is not allowed.
        """
        try:
            values = parse_json(text)
        except ValueError as error:
            raise ValueError(f"metadata: is not JSON: {error}") from error
        if not isinstance(values, dict):
            raise ValueError(f"metadata: must be an object, got {type(values).__name__}")
        unknown = sorted(set(values) - {each.name for each in fields(cls)})
        if unknown:
            raise ValueError(f"metadata: has unknown keys {', '.join(unknown)}")
        for name in ("input_size_px", "classes"):
            if name in values:
                if not isinstance(values[name], list):
                    raise ValueError(f"{name}: must be a list, got {values[name]!r}")
                values[name] = tuple(values[name])
        return cls(**values)
