"""Pose methods by name."""

from __future__ import annotations

from nav.pose.constant import constant
from nav.pose.interface import PoseMethod
from nav.pose.joint import joint
from nav.pose.mean_plane import mean_plane
from nav.pose.paper import paper

METHODS: dict[str, PoseMethod] = {
    "paper": paper,
    "joint": joint,
    "mean-plane": mean_plane,
    "constant": constant,
}


def pose_method(name: str) -> PoseMethod:
    """The method of that name.

    Raises:
        ValueError: there is none.
    """
    if name not in METHODS:
        raise ValueError(f"method: there is no pose method named {name!r}; there are {', '.join(METHODS)}")
    return METHODS[name]
