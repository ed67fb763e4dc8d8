"""What probed frames cost, kept in the user's cache, so that a recipe that is planned again need not render any."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import TypeAdapter

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import cpu_features, software_versions
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.user_cache import user_cache_folder
from drogue_models.untrusted_files import read_text
from droguekit.batch.frame_cost import ProbeResult
from render.device import Device, gpu_model
from render.version import RENDER_VERSION

_MOST_BYTES = 1_000_000
# The oldest ones go.
_MOST_KEPT = 200


@dataclass(frozen=True)
class RememberedProbe:
    """Frames that were probed before.

    Attributes:
        day: of the measurement, `2026-01-31`.
        result: what they cost.
    """

    day: str
    result: ProbeResult


_ADAPTER = TypeAdapter(RememberedProbe)


def remembered_probe(recipe: Recipe, device: Device) -> RememberedProbe | None:
    """What this machine measured of the recipe before with the same software, or None.

    The number of pairs and the splits may differ: a frame is the same frame in all of them. What was measured of a
    larger recipe tells nothing where it names frames that this one has not.
    """
    with suppress(OSError, ValueError):
        found = _ADAPTER.validate_json(read_text(_file(recipe, device), _MOST_BYTES))
        result = found.result
        frames = [*result.warm_up, *result.counted, *(drop.frame_index for drop in result.drops)]
        return found if max(frames) < recipe.frames.count else None
    return None


def remember_probe(recipe: Recipe, device: Device, result: ProbeResult) -> None:
    """Keep a measurement; where the cache cannot be written nothing is kept."""
    file = _file(recipe, device)
    probed = RememberedProbe(datetime.now(UTC).date().isoformat(), result)
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(file, _ADAPTER.dump_json(probed).decode() + "\n")
        kept = sorted(file.parent.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in kept[_MOST_KEPT:]:
            old.unlink()


def _file(recipe: Recipe, device: Device) -> Path:
    table = recipe.model_dump(mode="json")
    del table["split"], table["frames"]["count"]
    basis: list[object] = [table, device, RENDER_VERSION, software_versions(), cpu_features()]
    if device == "cuda":
        basis.append(gpu_model())
    digest = hashlib.sha256(canonical_json(basis).encode()).hexdigest()[:24]
    return user_cache_folder() / "probes" / f"{digest}.json"
