"""Reads recordings of the rerun viewer with rerun's own reader, which differs between its versions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr


def entities(path: Path) -> set[str]:
    """Paths of all entities with something in them."""
    if hasattr(rr, "dataframe"):
        return {column.entity_path for column in rr.dataframe.load_recording(path).schema().component_columns()}
    return {chunk.entity_path for chunk in _chunks(path)}


def values(path: Path, entity: str, component: str) -> dict[int, Any]:
    """Values of a component, such as `Position2D`, by frame; frames without one are left out."""
    if hasattr(rr, "dataframe"):
        table = rr.dataframe.load_recording(path).view(index="frame", contents=entity).select().read_all()
        (column,) = [column for column in table.column_names if column.endswith(f":{component}")]
        pairs = zip(table.column("frame").to_pylist(), table.column(column).to_pylist(), strict=True)
        return {frame: value for frame, value in pairs if value}
    found = {}
    for batch, column in _columns(path, entity, component):
        if "frame" in batch.schema.names:
            pairs = zip(batch.column("frame").to_pylist(), batch.column(column).to_pylist(), strict=True)
            found |= {frame: value for frame, value in pairs if value}
    return found


def shown_values(path: Path, entity: str, component: str, frames: Sequence[int]) -> dict[int, Any]:
    """What the viewer shows at each frame: the value that was told last, unless it was taken back."""
    if hasattr(rr, "dataframe"):
        view = rr.dataframe.load_recording(path).view(index="frame", contents=entity)
        view = view.using_index_values(np.array(frames, dtype=np.int64)).fill_latest_at()
        table = view.select().read_all()
        (column,) = [column for column in table.column_names if column.endswith(f":{component}")]
        pairs = zip(table.column("frame").to_pylist(), table.column(column).to_pylist(), strict=True)
        return {frame: value for frame, value in pairs if value}
    told, taken_back = values(path, entity, component), values(path, entity, "ClearIsRecursive")
    shown, last = {}, None
    for frame in sorted(frames):
        last = told.get(frame, None if frame in taken_back else last)
        if last is not None:
            shown[frame] = last
    return shown


def static_value(path: Path, entity: str, component: str) -> Any:
    """Of a component that does not change."""
    if hasattr(rr, "dataframe"):
        table = rr.dataframe.load_recording(path).view(index="frame", contents=entity).select_static().read_all()
        (column,) = [column for column in table.column_names if column.endswith(f":{component}")]
        return table.column(column).to_pylist()[0][0]
    ((batch, column),) = _columns(path, entity, component)
    return batch.column(column).to_pylist()[0][0]


def _chunks(path: Path) -> Iterator[Any]:
    from rerun.chunk import RrdReader

    yield from RrdReader(path).stream()


def _columns(path: Path, entity: str, component: str) -> Iterator[tuple[Any, str]]:
    """Record batches of an entity with the name of the component's column in them."""
    for chunk in _chunks(path):
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        for field in batch.schema:
            kind = (field.metadata or {}).get(b"rerun:component_type", b"").decode()
            if kind == f"rerun.components.{component}":
                yield batch, field.name
