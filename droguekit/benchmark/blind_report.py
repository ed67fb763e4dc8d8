"""The check of estimates without truth as one HTML page that needs nothing from outside."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.blind import BlindDataset, read_blind_index
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.benchmark.blind_check import BlindCheck, blind_scenes, marker_images_px, rim_box_px
from droguekit.benchmark.report.label_drawing import display_picture
from droguekit.benchmark.report.label_thumbnails import Tile, label_picture, spread, tile_of
from droguekit.benchmark.report.number_text import percent, plain_number, three_digits
from droguekit.benchmark.report.report import page_template

COLUMNS = ("pose found", "residual [px]", "views with a box", "middle in box", "overlap")
_MOST_TILES = 12


def row_cells(check: BlindCheck, method: str) -> list[str]:
    """A method's numbers as text, in the order of `COLUMNS`."""
    row = check.methods[method]
    return [
        percent(row.fix_fraction),
        three_digits(row.residual_rms_px),
        str(row.boxes),
        percent(row.middle_in_box_fraction),
        three_digits(row.rim_box_iou_median),
    ]


def write_blind_report(dataset: Location, estimates: Path, check: BlindCheck, out_html: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Raises:
        ValueError: dataset or estimates cannot be read.
        OSError: the page cannot be written.
    """
    # The method with the most poses shows what was found; the first of the file among equals.
    shown_method = max(check.methods, key=lambda name: check.methods[name].fixes)
    page = page_template("blind_report.html.j2").render(
        check=check,
        columns=COLUMNS,
        rows=[[name, *row_cells(check, name)] for name in check.methods],
        shown_method=shown_method,
        tiles=_tiles(dataset, estimates, shown_method),
    )
    write_text_atomic(out_html, page)


def _tiles(dataset: Location, estimates: Path, method: str) -> list[tuple[Tile, str]]:
    """Left images of some pairs with the pose of a method drawn in, and their captions."""
    index, source = read_blind_index(dataset), BlindDataset(dataset)
    scenes = blind_scenes(dataset, index)
    poses = {
        e.frame_index: e.left_from_drogue
        for e in read_estimates(estimates)
        if e.method == method and isinstance(e, PoseEstimate)
    }
    frames = [index.frames[place] for place in spread(len(index.frames), _MOST_TILES)]
    tiles = []
    for frame in frames:
        scene, pose = scenes[frame], poses.get(frame)
        box = scene.boxes.get("left")
        centers: list[tuple[float, float]] = []
        distance_m, caption = 0.0, f"Frame {frame}, no pose"
        if pose is not None:
            box = box or rim_box_px(scene, pose, "left")
            centers = [(float(x), float(y)) for x, y in marker_images_px(scene, pose, "left")]
            distance_m = float(pose.translation_m[2])
            caption = f"Frame {frame}, {plain_number(distance_m)} m"
        picture = label_picture(display_picture(source.pair(frame).images), box, centers)
        tiles.append((tile_of(frame, distance_m, picture), caption))
    return tiles
