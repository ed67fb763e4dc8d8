"""A dataset as navigation may see it: images, time stamps, rig and the drogue, nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from datasets_manifest.images import StereoImages
from datasets_manifest.layout import frame_folder
from datasets_manifest.manifest import read_manifest
from datasets_manifest.reader import read_images, read_shutter, read_sought
from drogue_models.parameters import DrogueParameters
from geometry.stereo import StereoRig


@dataclass(frozen=True, eq=False)
class BlindPair:
    """One stereo pair.

    Attributes:
        frame_index: place in the dataset.
        images: what the cameras saw, with time stamp and exposure.
        rig: the cameras.
        drogue: what to look for; whether it is there is for the images to tell.
    """

    frame_index: int
    images: StereoImages
    rig: StereoRig
    drogue: DrogueParameters


class BlindDataset:
    """Stereo pairs without their truth; images are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Open the dataset in a folder.

        Raises:
            ValueError: no such folder, or no manifest that can be trusted.
        """
        manifest = read_manifest(path)
        self._path = path
        self._rig: StereoRig = manifest.recipe.rig
        self._drogue = manifest.recipe.drogue
        self._has_variants = bool(manifest.recipe.variants)
        self._sensor = manifest.recipe.sensor
        self.frame_indices: tuple[int, ...] = tuple(sorted(entry.frame_index for entry in manifest.frames))

    def pair(self, frame_index: int) -> BlindPair:
        """One stereo pair.

        Raises:
            ValueError: it is missing, truncated or of another size or depth than the rig's; names the file.
        """
        shutter = read_shutter(self._path, frame_index)
        folder = frame_folder(self._path, frame_index)
        images = read_images(folder, self._rig.camera, self._sensor, shutter)
        drogue = read_sought(self._path, frame_index, self._drogue) if self._has_variants else self._drogue
        return BlindPair(frame_index, images, self._rig, drogue)
