"""What the seed paper prints of its detectors, on data of its own."""

from __future__ import annotations

from typing import NamedTuple


class PublishedDetector(NamedTuple):
    """A row of the seed paper's table of detectors.

    Attributes:
        precision, recall, ap50: fractions; the paper does not say at which threshold.
        gflops: of one image, as the paper counts them.
        image_s: time of an image on an Nvidia Xavier AGX. [s]
    """

    name: str
    precision: float
    recall: float
    ap50: float
    gflops: float
    image_s: float


# Table 1 of the seed paper (docs/explanation/paper.md), digit for digit.
PUBLISHED_DETECTORS = (
    PublishedDetector("YOLOv8s", 0.9266, 0.9521, 0.9839, 28.6, 0.0387),
    PublishedDetector("YOLOv5s", 0.9174, 0.9599, 0.9812, 16.5, 0.0311),
    PublishedDetector("Efficientnet-B5", 0.9107, 0.9348, 0.9668, 9.9, 0.0280),
    PublishedDetector("Faster-RCNN", 0.948, 0.9634, 0.9711, 344.4, 0.181),
    PublishedDetector("SSD", 0.9179, 0.9203, 0.9533, 31.0, 0.0470),
    PublishedDetector("YOLOv4", 0.9205, 0.9205, 0.9559, 52.0, 0.0818),
    PublishedDetector("ours-l", 0.93, 0.995, 0.9823, 9.3, 0.0243),
    PublishedDetector("ours-s", 0.9429, 0.9149, 0.9629, 6.0, 0.0202),
)
