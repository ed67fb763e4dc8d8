"""Checks ROS 2 bags in a dataset's folder against the dataset, with the independent mcap library."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from geometry.stereo import EYES

# Numbers that went through float64 and one product.
_TOLERANCE = 1e-12


def bag_files(dataset: Location) -> list[str]:
    """Names of the bags' files below a dataset, sorted; links are not followed."""
    return open_storage(dataset).files_ending(".mcap")


def bag_faults(dataset: Dataset, names: list[str]) -> list[str]:
    """Faults of the bags: unpaired images, missing pairs, another calibration than the dataset's.

    Args:
        dataset: from which they were exported.
        names: of all bag files.
    """
    storage = open_storage(dataset.path)
    paths = {name: storage.where(name) for name in names}
    try:
        import mcap.reader  # noqa: F401
        import mcap_ros2.decoder  # noqa: F401
    except ModuleNotFoundError as error:
        return [
            f"{path}: cannot be checked, for {error.name} is missing: pip install mcap-ros2-support"
            for path in paths.values()
        ]
    faults, pairs = [], 0
    for name, path in paths.items():
        try:
            with storage.local_copy(name) as file:
                stamps, infos = _contents(file)
        # Any error that the library raises on a damaged bag.
        except Exception as error:
            faults.append(f"{path}: is damaged: {' '.join(str(error).split()) or type(error).__name__}")
            continue
        left, right = (stamps[f"/stereo/{eye}/image_raw"] for eye in EYES)
        pairs += len(left)
        if left != right or len(set(left)) < len(left):
            faults.append(
                f"{path}: {len(left)} left and {len(right)} right images, which must come in pairs of one time"
            )
        faults += [f"{path}: {fault}" for fault in _calibration_faults(dataset, infos)]
    if not faults and pairs != len(dataset.frame_indices):
        where = paths[names[0]].rpartition("/")[0]
        faults.append(f"{where}: bags hold {pairs} pairs, the dataset {len(dataset.frame_indices)}")
    return faults


def _contents(path: Path) -> tuple[dict[str, list[int]], dict[str, Any]]:
    """Times of all messages by topic [ns], and the first CameraInfo of each topic."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    stamps: defaultdict[str, list[int]] = defaultdict(list)
    infos: dict[str, Any] = {}
    with path.open("rb") as stream:
        for _, channel, raw, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            stamps[channel.topic].append(raw.log_time)
            if channel.topic.endswith("/camera_info"):
                infos.setdefault(channel.topic, message)
    return stamps, infos


def _calibration_faults(dataset: Dataset, infos: dict[str, Any]) -> list[str]:
    want, faults = opencv_stereo_matrices(dataset.manifest.recipe.rig), []
    for number, eye in enumerate(EYES, start=1):
        info = infos.get(f"/stereo/{eye}/camera_info")
        if info is None:
            faults.append(f"has no CameraInfo of the {eye} eye")
            continue
        for name, given in (("M", info.k), ("D", info.d), ("R", info.r), ("P", info.p)):
            exact = want[f"{name}{number}"].ravel()
            found = np.asarray(given, dtype=np.float64)
            if found.shape != exact.shape or not np.allclose(found, exact, rtol=_TOLERANCE, atol=_TOLERANCE):
                faults.append(f"CameraInfo of the {eye} eye: {name}{number} is not that of the dataset's rig")
    return faults
