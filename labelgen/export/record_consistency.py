"""Records whose parts contradict each other, which no format can hold: found before anything is made of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # The command's help lists the formats without loading what reads a dataset.
    from datasets_manifest.types.records import PairRecord, PixelBox, ViewRecord
    from geometry.pinhole import PinholeCamera

_LARGEST_ID = 2**63 - 1


def record_fault(record: PairRecord) -> str | None:
    """What in a record contradicts the rest of it, or None; `droguekit validate` looks closer, and at the pixels."""
    if max(record.scene_id, record.sequence_id or 0) > _LARGEST_ID:
        return f"scene_id, sequence_id: must be at most {_LARGEST_ID}"
    angles = (record.pitch_deg, record.yaw_deg, record.roll_deg, record.roll_modulo_deg)
    for value in (record.left_from_drogue, *angles):
        if (value is None) != (record.frame.drogue is None):
            return "left_from_drogue, angles: must be given exactly when the frame has a drogue"
    for eye, view in (("left", record.views.left), ("right", record.views.right)):
        fault = _view_fault(record, view)
        if fault is not None:
            return f"views.{eye}.{fault}"
    return None


def _view_fault(record: PairRecord, view: ViewRecord) -> str | None:
    drogue, camera = record.frame.drogue, record.frame.rig.camera
    count = 0 if drogue is None else drogue.marker_count
    if len(view.markers) != count:
        return f"markers: must be {count} as the frame's drogue has, got {len(view.markers)}"
    if (view.hub is None) != (drogue is None or drogue.hub is None):
        return "hub: must be given exactly when the frame's drogue has one"
    if (view.box_full_xywh_px is None) != (drogue is None):
        return "box_full_xywh_px: must be given exactly when the frame has a drogue"
    if (view.box_visible_xywh_px is None) != (view.visible_drogue_px == 0) or (
        drogue is None and view.visible_drogue_px
    ):
        return "box_visible_xywh_px: must be given exactly when pixels of a drogue are visible"
    if view.box_visible_xywh_px is not None and not _is_pixels(view.box_visible_xywh_px, camera):
        return f"box_visible_xywh_px: must be around whole pixels of the image, got {view.box_visible_xywh_px}"
    if view.visible_drogue_px > camera.width_px * camera.height_px:
        return f"visible_drogue_px: is more than the image has, got {view.visible_drogue_px}"
    return None


def _is_pixels(box: PixelBox, camera: PinholeCamera) -> bool:
    u, v, width, height = box[0] + 0.5, box[1] + 0.5, box[2], box[3]
    return (
        all(number.is_integer() for number in (u, v, width, height))
        and min(u, v) >= 0
        and min(width, height) >= 1
        and u + width <= camera.width_px
        and v + height <= camera.height_px
    )
