"""Records of drogues that nobody has rendered: their features stand where the projection puts them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.rigs import SENSORS
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.writer import encode_files, write_frame
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.estimates import Estimate, Feature, NoFix, PoseEstimate
from datasets_manifest.types.frame import Exposure, FrameSpec
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import Conditions, FeatureView, HubView, PairRecord, StereoViews, ViewRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters, HubParameters, even_ring
from geometry.circles import disc_outline, project_disc_centers
from geometry.se3 import RigidTransform, angles_from_rotation, exp_twist, log_twist, rotation_from_angles
from geometry.stereo import EYES, Eye, paper_rig
from tests.support.recipe_builder import between, build_recipe

RIG = paper_rig()
SIGMA_COVARIANCE = ((1e-4, 0.0), (0.0, 1e-4))


def make_drogue(count: int = 8, ring_m: float = 0.27, hub: HubParameters | None = None) -> DrogueParameters:
    # The ring of the golden numbers, 0.28 m, leaves no face around the markers unless the rim's tube is thin.
    return DrogueParameters(
        name="test",
        marker_positions_m=even_ring(count, ring_m),
        hub=hub,
        rim_tube_radius_m=1e-5,
        rim_radius_m=0.3301,
    )


def make_pose(
    x_m: float, y_m: float, z_m: float, pitch_deg: float = 0.0, yaw_deg: float = 0.0, roll_deg: float = 0.0
) -> RigidTransform:
    return RigidTransform(
        rotation_from_angles(*np.deg2rad([pitch_deg, yaw_deg, roll_deg])), np.array([x_m, y_m, z_m], dtype=np.float64)
    )


def _view(drogue: DrogueParameters, pose: RigidTransform, eye: Eye) -> ViewRecord:
    layout = marker_layout(drogue)
    radii = np.full(layout.count, layout.radius_m)
    image = RIG.project(pose.apply(layout.centers_m), eye)
    ellipse = project_disc_centers(RIG, pose, layout.centers_m, radii, eye)
    markers = tuple(
        FeatureView(
            center_proj_px=tuple(p), center_ellipse_px=tuple(e), visible_fraction=1, in_image=True, signal_to_noise=50
        )
        for p, e in zip(image.tolist(), ellipse.tolist(), strict=True)
    )
    hub = None
    if layout.hub_center_m is not None:
        point = layout.hub_center_m[None]
        edges = [
            project_disc_centers(RIG, pose, point, [radius], eye)[0].tolist()
            for radius in (layout.hub_outer_radius_m, layout.hub_inner_radius_m)
        ]
        hub = HubView(
            center_proj_px=tuple(RIG.project(pose.apply(point), eye)[0].tolist()),
            center_ellipse_px=edges[0],
            center_ellipse_inner_px=edges[1],
            visible_fraction=1,
            in_image=True,
            signal_to_noise=50,
        )
    half = RIG.camera.fx_px * drogue.rim_radius_m / pose.translation_m[2]
    middle = RIG.project(pose.translation_m, eye)
    box = (middle[0] - half, middle[1] - half, 2 * half, 2 * half)
    return ViewRecord(
        markers=markers,
        hub=hub,
        box_full_xywh_px=box,
        box_visible_xywh_px=box,
        visible_drogue_px=round(np.pi * half**2),
        truncated=False,
    )


def make_record(frame_index: int, pose: RigidTransform | None, drogue: DrogueParameters | None = None) -> PairRecord:
    shown = (drogue or make_drogue(hub=HubParameters())) if pose is not None else None
    frame = FrameSpec(
        seed=1,
        frame_index=frame_index,
        scene_id=0,
        time_s=0.0,
        drogue=shown,
        left_from_drogue=pose,
        world_from_left=RigidTransform.identity(),
        left_twist_per_s=np.zeros(6),
        drogue_twist_per_s=np.zeros(6),
        left_from_tanker=None,
        hose_nodes_left_m=None,
        rig=RIG,
        sensor=SENSORS["rgb-ideal"],
        exposure=Exposure(time_s=1e-3, f_number=2.8),
        environment=Environment(
            sun_elevation_deg=40,
            sun_azimuth_deg=0,
            turbidity=3,
            visibility_m=40_000,
            altitude_m=3000,
            ground_reflectance_rgb=(0.1, 0.1, 0.1),
            ground_texture_seed=1,
        ),
    )
    nothing = ViewRecord(
        markers=(),
        hub=None,
        box_full_xywh_px=None,
        box_visible_xywh_px=None,
        visible_drogue_px=0,
        truncated=False,
    )
    views = [nothing if shown is None or pose is None else _view(shown, pose, eye) for eye in EYES]
    angles = [None] * 3 if pose is None else np.rad2deg(angles_from_rotation(pose.rotation)).tolist()
    return PairRecord(
        frame_index=frame_index,
        scene_id=0,
        sequence_id=None,
        time_s=0.0,
        left_from_drogue=pose,
        left_from_drogue_open=pose,
        left_from_drogue_close=pose,
        pitch_deg=angles[0],
        yaw_deg=angles[1],
        roll_deg=angles[2],
        roll_modulo_deg=None if angles[2] is None else angles[2] % 45,
        views=StereoViews(left=views[0], right=views[1]),
        conditions=Conditions(
            family="clear",
            distance_m=None if pose is None else float(pose.translation_m[2]),
            sun_elevation_deg=40,
            background_luminance_cd_m2=3000,
            monte_carlo_noise_fraction=0.01,
        ),
        engine="none",
        engine_version="0",
        file_sha256={},
        frame=frame,
    )


def make_features(record: PairRecord, offset_px: Callable[[], Sequence[float]], turn: int = 0) -> tuple[Feature, ...]:
    """Measurements of every feature, `offset_px` off; `turn` renumbers the markers."""
    features = []
    for eye, view in (("left", record.views.left), ("right", record.views.right)):
        named = [((i + turn) % len(view.markers), marker) for i, marker in enumerate(view.markers)]
        for index, truth in [*named, *([("hub", view.hub)] if view.hub is not None else [])]:
            du, dv = offset_px()
            u, v = truth.center_ellipse_px
            features.append(
                Feature(eye=eye, index=index, center_px=(u + du, v + dv), cov_px2=SIGMA_COVARIANCE, used=True)
            )
    return tuple(features)


def make_estimate(
    frame_index: int, pose: RigidTransform, method: str = "joint", features: tuple[Feature, ...] = ()
) -> PoseEstimate:
    return PoseEstimate(frame_index=frame_index, method=method, left_from_drogue=pose, features=features)


def _picture(record: PairRecord, eye: Eye) -> np.ndarray:
    """A bright sky with a dark disc and coloured markers: enough to see where labels lie."""
    camera = RIG.camera
    rows = np.linspace(90, 160, camera.height_px)[:, None, None]
    picture = np.repeat(rows * [0.7, 0.85, 1.0], camera.width_px, axis=1).astype(np.uint8)
    drogue, pose = record.frame.drogue, record.left_from_drogue
    if drogue is None or pose is None:
        return picture
    layout = marker_layout(drogue)

    def disc(center_m: Sequence[float], radius_m: float, color: tuple[int, int, int]) -> None:
        outline = RIG.project(disc_outline(pose, center_m, radius_m, 64), eye)
        cv2.fillPoly(picture, [np.rint(outline * 16).astype(np.int32)], color, cv2.LINE_AA, shift=4)

    disc((0, 0, 0), drogue.rim_radius_m, (12, 12, 12))
    disc((0, 0, 0), drogue.face_inner_radius_m, (28, 30, 26))
    for center in layout.centers_m:
        disc(center, layout.radius_m, (150, 14, 14))
    if layout.hub_center_m is not None:
        disc(layout.hub_center_m, layout.hub_outer_radius_m, (150, 14, 14))
        disc(layout.hub_center_m, layout.hub_inner_radius_m, (8, 8, 8))
    return picture


def make_dataset(folder: Path, records: Sequence[PairRecord], alike: bool = False) -> Path:
    """A dataset on disk of records made here, with plain pictures; where they are `alike`, all have the first's."""
    parts = {eye: np.zeros((RIG.camera.height_px, RIG.camera.width_px), np.uint8) for eye in EYES}
    for record in records:
        if not alike or record is records[0]:
            left, right = (_picture(record, eye) for eye in EYES)
            images = StereoImages(left=left, right=right, time_s=0.0, exposure_s=1e-3)
            files = encode_files(images, parts)
        write_frame(folder, record, files)
    recipe = build_recipe(
        name="bench-test",
        description="Flat pictures of a drogue.",
        frames={"count": len(records)},
        distance=between(1.7, 40),
    )
    write_manifest(folder, build_manifest(folder, recipe, "test", dict.fromkeys(range(recipe.frames.scenes), "train")))
    return folder


def make_estimates(
    records: Sequence[PairRecord], methods: dict[str, float], rng: np.random.Generator, sigma_px: float = 0.1
) -> list[Estimate]:
    """Poses that err like the bound times a factor, along depth and across, with the centroids that go with it."""
    estimates: list[Estimate] = []
    for record in records:
        pose = record.left_from_drogue
        if pose is None:
            estimates += [NoFix(frame_index=record.frame_index, method=name, reason="nothing seen") for name in methods]
            continue
        features = make_features(record, lambda: rng.normal(0, sigma_px, 2))
        z = pose.translation_m[2]
        for name, factor in methods.items():
            scale = factor * sigma_px * z * np.array([1.2e-4, 1.2e-4, 4e-4 * z])
            offset = rng.normal(0, scale)
            turn = rng.normal(0, factor * sigma_px * z * 1.5e-3, 3)
            rotation = exp_twist(np.r_[0, 0, 0, turn]).rotation @ pose.rotation
            moved = RigidTransform(rotation, pose.translation_m + offset)
            estimates.append(
                PoseEstimate(
                    frame_index=record.frame_index,
                    method=name,
                    left_from_drogue=moved,
                    features=features,
                    stage_s={"detect": 0.012, "centroids": 0.0045, "pose": 0.003 * factor},
                )
            )
    return estimates


def make_records(stations_m: Sequence[float], count: int, rng: np.random.Generator, empty: int = 0) -> list[PairRecord]:
    """`count` pairs at each station inside the common field of view, then `empty` pairs without a drogue."""
    records = []
    for z in np.repeat(stations_m, count):
        x_low, x_high, y_low, y_high = RIG.common_field_m(z, 0.36) or (0.06, 0.06, 0.0, 0.0)
        place = rng.uniform([x_low, y_low], [x_high, y_high])
        records.append(make_record(len(records), make_pose(*place, z, *rng.uniform(-10, 10, 2), rng.uniform(-22, 22))))
    return [*records, *(make_record(len(records) + k, None) for k in range(empty))]


FRAME_RATE_HZ = 25.0


def make_sequence(
    pose_at: Callable[[float], RigidTransform], count: int, sequence_id: int = 0, hidden: Sequence[int] = ()
) -> list[PairRecord]:
    """Pairs of a drogue that moves, at 25 Hz; `hidden` are the places of those that show nothing of it.

    Indices and times go on from the sequence before, of as many pairs, 10 s later.
    """
    records = []
    for k in range(count):
        time_s, step_s = k / FRAME_RATE_HZ, 1e-4
        twist = log_twist(pose_at(time_s - step_s).inverse() @ pose_at(time_s + step_s)) / (2 * step_s)
        record = make_record(sequence_id * count + k, pose_at(time_s))
        changes = {
            "time_s": sequence_id * (count / FRAME_RATE_HZ + 10) + time_s,
            "sequence_id": sequence_id,
        }
        frame = record.frame.model_copy(update={**changes, "drogue_twist_per_s": twist})
        views = (
            record.views
            if k not in hidden
            else StereoViews(left=_unseen(record.views.left), right=_unseen(record.views.right))
        )
        records.append(record.model_copy(update={**changes, "frame": frame, "views": views}))
    return records


def _unseen(view: ViewRecord) -> ViewRecord:
    markers = tuple(marker.model_copy(update={"visible_fraction": 0.0}) for marker in view.markers)
    return view.model_copy(update={"markers": markers, "box_visible_xywh_px": None, "visible_drogue_px": 0})


def swinging(time_s: float) -> RigidTransform:
    """A drogue that comes nearer, swings with 1.1 Hz and nods with 0.7 Hz."""
    swing, nod = np.sin(2 * np.pi * 1.1 * time_s), np.sin(2 * np.pi * 0.7 * time_s + 0.4)
    return make_pose(0.06 + 0.1 * swing, 0.05 * nod, 6.0 - 0.5 * time_s + 0.03 * nod, 4 * nod, 3 * swing, 10.0)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PairRecord]]:
    """Nine pairs at three stations and one without a drogue."""
    records = make_records([2.0, 8.0, 30.0], 3, np.random.default_rng(3), empty=1)
    return make_dataset(tmp_path_factory.mktemp("dataset"), records), records


@pytest.fixture(scope="session")
def build() -> SimpleNamespace:
    return SimpleNamespace(
        drogue=make_drogue,
        pose=make_pose,
        record=make_record,
        features=make_features,
        estimate=make_estimate,
        hub=HubParameters,
        records=make_records,
        estimates=make_estimates,
        dataset=make_dataset,
        sequence=make_sequence,
        swinging=swinging,
        rig=RIG,
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
