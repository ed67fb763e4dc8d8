"""What lies below the camera of one scene."""

from __future__ import annotations

from typing import Literal, get_args

GroundKind = Literal["sea", "forest", "fields", "dry", "coast", "town"]

GROUND_KINDS: tuple[GroundKind, ...] = get_args(GroundKind)
