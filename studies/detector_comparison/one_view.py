"""Our network with a pass for each eye: what a network that was trained on single eyes is timed as."""

from __future__ import annotations

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, StereoDetection
from nav.detector.input_image import input_image
from nav.detector.onnx_detector import OnnxDetector


class OneViewDetector(OnnxDetector):
    """The same network and boxes, but each eye in passes of its own."""

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, where it scores as much as the file asks for."""
        found = self.candidates(images, self.metadata.score_threshold)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """Boxes of each image, the best first, without those that overlap a better one."""
        answers: dict[Eye, tuple[Detection, ...]] = {}
        for eye in EYES:
            picture, place = input_image(images, eye, self.input_size_px)
            ((boxes, scores),) = self._found([picture], least_score, most=20)
            answers[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(place.to_image(boxes).tolist(), scores.tolist(), strict=True)
            )
        return answers
