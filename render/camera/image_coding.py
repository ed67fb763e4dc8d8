"""What happens to a picture on its way to the viewer: interlace, overlays, lower resolution, and lossy coding.

All of it is symmetrical about every pixel's own place, so that nothing moves.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.video_camera import ImageCoding, Overlay, VideoCamera
from geometry.compiled_loops import compiled

Picture = NDArray[np.uint8]

_BLOCK = 4
_FRAMES_PER_S = 25


def deliver(picture: Picture, frame: FrameSpec, camera: VideoCamera) -> Picture:
    """The picture that a viewer sees.

    Args:
        picture: (H, W, 3) or (H, W).
        frame: gives the time of an overlay.
        camera: with coding and overlay.
    """
    coding = camera.coding
    if coding.is_interlaced:
        picture = one_field(picture)
    if camera.overlay is not None:
        picture = draw_overlay(picture, camera.overlay, frame.time_s)
    height, width = picture.shape[:2]
    size = round(coding.resolution_fraction * width), round(coding.resolution_fraction * height)
    if coding.resolution_fraction < 1.0:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    picture = _decoded(picture, coding)
    if coding.resolution_fraction < 1.0:
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
    return picture


def one_field(picture: Picture) -> Picture:
    """Every other row, and between them the mean of the rows above and below."""
    result = picture.copy()
    above, below = picture[0:-2:2], picture[2::2]
    result[1 : 1 + 2 * len(below) : 2] = cv2.addWeighted(above, 0.5, below, 0.5, 0.0).reshape(below.shape)
    if len(picture) % 2 == 0:
        result[-1] = picture[-2]
    return result


def draw_overlay(picture: Picture, overlay: Overlay, time_s: float) -> Picture:
    """A copy with lines and text over it.

    Args:
        picture: (H, W, 3) or (H, W).
        overlay: what to draw.
        time_s: of the frame. [s]
    """
    height, width = picture.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    thick = max(1, round(height / 600))
    if overlay.has_frame:
        inset = max(2, round(0.03 * height))
        cv2.rectangle(mask, (inset, inset), (width - 1 - inset, height - 1 - inset), 255, thick, cv2.LINE_AA)
    if overlay.has_crosshair:
        u, v, gap, arm = width // 2, height // 2, round(0.02 * height), round(0.07 * height)
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            near, far = (u + du * gap, v + dv * gap), (u + du * arm, v + dv * arm)
            cv2.line(mask, near, far, 255, thick, cv2.LINE_AA)
    if overlay.is_timecoded:
        frames = round(time_s * _FRAMES_PER_S)
        seconds, count = divmod(max(frames, 0), _FRAMES_PER_S)
        text = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}:{count:02d}  {frames:06d}"
        at = round(0.05 * width), round(0.07 * height) if overlay.is_at_top else height - round(0.05 * height)
        cv2.putText(mask, text, at, cv2.FONT_HERSHEY_SIMPLEX, height / 1100, 255, thick, cv2.LINE_AA)
    result = picture.copy()
    drawn = mask > 0
    share = (overlay.opacity / 255.0) * mask[drawn].astype(np.float32)
    share = share if picture.ndim == 2 else share[:, None]
    under = picture[drawn].astype(np.float32)
    result[drawn] = np.rint(under + (255.0 * overlay.level - under) * share).astype(np.uint8)
    return result


def _decoded(picture: Picture, coding: ImageCoding) -> Picture:
    if coding.codec == "jpeg":
        return jpeg(picture, coding.quality)
    if coding.codec == "h264-intra":
        return intra_coded(picture, coding.quantizer)
    return picture


def jpeg(picture: Picture, quality: int) -> Picture:
    """The picture after JPEG, with chroma at half the resolution."""
    is_grey = picture.ndim == 2
    stored = picture if is_grey else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE if is_grey else cv2.IMREAD_COLOR)
    assert decoded is not None, "what OpenCV wrote, it reads"
    return np.asarray(decoded if is_grey else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def intra_coded(picture: Picture, quantizer: int) -> Picture:
    """The picture after coding as an intra picture of H.264 has it, with chroma at half the resolution.

    Blocks of 4 x 4 are predicted from their decoded neighbours (vertical, horizontal or mean, whichever fits best); the
    cosine transform of the rest is quantised, and the edges of blocks are filtered. Blocks of other sizes and the other
    modes are left out: they save bits, which nobody counts here.

    Source: ITU-T H.264, 8.3.1 (prediction), 8.5 (quantiser step 0.625 at parameter 0, doubled every 6), 8.7 (filter).
    """
    if picture.ndim == 2:
        return _coded_plane(picture, quantizer)
    height, width = picture.shape[:2]
    luma, red, blue = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb))
    half = (width + 1) // 2, (height + 1) // 2
    planes = [_coded_plane(luma, quantizer)]
    for chroma in (red, blue):
        coded = _coded_plane(cv2.resize(chroma, half, interpolation=cv2.INTER_AREA), quantizer)
        planes.append(cv2.resize(coded, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.asarray(cv2.cvtColor(cv2.merge(planes), cv2.COLOR_YCrCb2RGB), dtype=np.uint8)


def _coded_plane(plane: NDArray[np.uint8], quantizer: int) -> NDArray[np.uint8]:
    height, width = plane.shape
    padded = cv2.copyMakeBorder(plane, 0, -height % _BLOCK, 0, -width % _BLOCK, cv2.BORDER_REPLICATE)
    _code_blocks(padded, np.float32(0.625 * 2.0 ** (quantizer / 6.0)))
    # Closed forms near the standard's tables of alpha and beta.
    alpha, beta = round(0.8 * (2.0 ** (quantizer / 6.0) - 1.0)), round(0.5 * quantizer - 7.0)
    if alpha > 0 and beta > 0:
        _filter_edges(padded, alpha, beta, max(1, alpha // 8))
    coded: NDArray[np.uint8] = padded[:height, :width]
    return coded


@compiled
def _code_blocks(plane: NDArray[np.uint8], step: np.float32) -> None:
    """Replace every block, in place, by what a decoder has after it."""
    rows, columns = plane.shape
    # Rows of the orthonormal cosine transform of length 4.
    half, wide, narrow = np.float32(0.5), np.float32(0.6532815), np.float32(0.27059805)
    rest, coded = np.empty((4, 4), np.float32), np.empty((4, 4), np.float32)
    for top in range(0, rows, 4):
        for left in range(0, columns, 4):
            total, count = np.float32(0.0), 0
            for k in range(4):
                if top > 0:
                    total += np.float32(plane[top - 1, left + k])
                    count += 1
                if left > 0:
                    total += np.float32(plane[top + k, left - 1])
                    count += 1
            mean = total / np.float32(count) if count else np.float32(128.0)
            from_mean, from_top, from_left = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for i in range(4):
                for j in range(4):
                    value = np.float32(plane[top + i, left + j])
                    from_mean += abs(value - mean)
                    if top > 0:
                        from_top += abs(value - np.float32(plane[top - 1, left + j]))
                    if left > 0:
                        from_left += abs(value - np.float32(plane[top + i, left - 1]))
            by_top = top > 0 and from_top < from_mean and (left == 0 or from_top <= from_left)
            by_left = left > 0 and not by_top and from_left < from_mean
            for i in range(4):
                for j in range(4):
                    guess = mean
                    if by_top:
                        guess = np.float32(plane[top - 1, left + j])
                    elif by_left:
                        guess = np.float32(plane[top + i, left - 1])
                    coded[i, j] = guess
                    rest[i, j] = np.float32(plane[top + i, left + j]) - guess
            for i in range(4):
                outer, inner = rest[i, 0] + rest[i, 3], rest[i, 1] + rest[i, 2]
                odd_outer, odd_inner = rest[i, 0] - rest[i, 3], rest[i, 1] - rest[i, 2]
                rest[i, 0], rest[i, 2] = half * (outer + inner), half * (outer - inner)
                rest[i, 1] = wide * odd_outer + narrow * odd_inner
                rest[i, 3] = narrow * odd_outer - wide * odd_inner
            for j in range(4):
                outer, inner = rest[0, j] + rest[3, j], rest[1, j] + rest[2, j]
                odd_outer, odd_inner = rest[0, j] - rest[3, j], rest[1, j] - rest[2, j]
                rest[0, j], rest[2, j] = half * (outer + inner), half * (outer - inner)
                rest[1, j] = wide * odd_outer + narrow * odd_inner
                rest[3, j] = narrow * odd_outer - wide * odd_inner
                for i in range(4):
                    # To the nearest step: rounding down, which saves encoders bits, drags edges after the scan.
                    size = np.float32(int(abs(rest[i, j]) / step + np.float32(0.5))) * step
                    rest[i, j] = size if rest[i, j] > 0 else -size
                even, odd = half * (rest[0, j] + rest[2, j]), half * (rest[0, j] - rest[2, j])
                outer = wide * rest[1, j] + narrow * rest[3, j]
                inner = narrow * rest[1, j] - wide * rest[3, j]
                rest[0, j], rest[3, j] = even + outer, even - outer
                rest[1, j], rest[2, j] = odd + inner, odd - inner
            for i in range(4):
                even, odd = half * (rest[i, 0] + rest[i, 2]), half * (rest[i, 0] - rest[i, 2])
                outer = wide * rest[i, 1] + narrow * rest[i, 3]
                inner = narrow * rest[i, 1] - wide * rest[i, 3]
                rest[i, 0], rest[i, 3] = even + outer, even - outer
                rest[i, 1], rest[i, 2] = odd + inner, odd - inner
                for j in range(4):
                    value = coded[i, j] + rest[i, j] + half
                    plane[top + i, left + j] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))


@compiled
def _filter_edges(plane: NDArray[np.uint8], alpha: int, beta: int, most: int) -> None:
    """Smooth small steps between blocks, in place: first across columns, then across rows."""
    rows, columns = plane.shape
    for across_rows in (False, True):
        for row in range(4 if across_rows else 0, rows, 4 if across_rows else 1):
            for column in range(0 if across_rows else 4, columns, 1 if across_rows else 4):
                di, dj = (1, 0) if across_rows else (0, 1)
                p1, p0 = int(plane[row - 2 * di, column - 2 * dj]), int(plane[row - di, column - dj])
                q0, q1 = int(plane[row, column]), int(plane[row + di, column + dj])
                if abs(p0 - q0) < alpha and abs(p1 - p0) < beta and abs(q1 - q0) < beta:
                    change = min(max((4 * (q0 - p0) + (p1 - q1) + 4) >> 3, -most), most)
                    plane[row - di, column - dj] = np.uint8(min(max(p0 + change, 0), 255))
                    plane[row, column] = np.uint8(min(max(q0 - change, 0), 255))
