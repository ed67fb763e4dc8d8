"""Pose methods by name: built-in ones, and those that other packages register.

A package registers a method by an entry point of the group `droguekit.pose_estimators`: the entry point's name is the
method's, and its object is a function of the type `nav.pose.pose_method.PoseMethod`.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from nav.pose.joint import joint, joint_hub, joint_robust
from nav.pose.joint_rim import joint_rim
from nav.pose.monocular import mono_circle, mono_ippe, mono_lm, mono_sqpnp
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, Solution
from nav.pose.triangulation_methods import circle_fit, constant, disparity_plane, mean_plane, paper, paper_literal

ENTRY_POINT_GROUP = "droguekit.pose_estimators"

METHODS: dict[str, PoseMethod] = {
    "paper": paper,
    "paper-literal": paper_literal,
    "circle-fit": circle_fit,
    "mono-circle": mono_circle,
    "mean-plane": mean_plane,
    "disparity-plane": disparity_plane,
    "mono-ippe": mono_ippe,
    "mono-sqpnp": mono_sqpnp,
    "mono-lm": mono_lm,
    "joint": joint,
    "joint-hub": joint_hub,
    "joint-robust": joint_robust,
    "joint-rim": joint_rim,
    "constant": constant,
}


def method_names() -> tuple[str, ...]:
    """Names of the built-in methods, then of other packages' in alphabetical order.

    Raises:
        ValueError: a package registers a name that is taken.
    """
    return (*METHODS, *sorted(_registered()))


def pose_method(name: str) -> PoseMethod:
    """The method of that name.

    Raises:
        ValueError: there is none, or it cannot be loaded.
    """
    if name in METHODS:
        return METHODS[name]
    others = _registered()
    if name not in others:
        raise ValueError(f"method: there is no pose method named {name!r}; there are {', '.join([*METHODS, *others])}")
    return _load(others[name])


def _registered() -> dict[str, EntryPoint]:
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        # An installation that is found along two paths is one method.
        if entry.name in METHODS or found.get(entry.name, entry).value != entry.value:
            raise ValueError(f"method: {entry.value} registers {entry.name!r}, which is taken; rename its entry point")
        found[entry.name] = entry
    return dict(sorted(found.items()))


def _load(entry: EntryPoint) -> PoseMethod:
    try:
        solve = entry.load()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"method: {entry.name!r} cannot be loaded from {entry.value}: {error}") from error
    if not callable(solve):
        raise ValueError(f"method: {entry.name!r} must be a function, got {type(solve).__name__} from {entry.value}")

    def checked(observation: Observation) -> Solution | NoFixReason:
        answer = solve(observation)
        if not isinstance(answer, Solution | NoFixReason):
            raise ValueError(f"method: {entry.name!r} must answer Solution or NoFixReason, got {type(answer).__name__}")
        return answer

    return checked
