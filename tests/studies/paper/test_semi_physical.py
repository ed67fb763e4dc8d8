"""The bench experiment: means by station, against truth and readings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Feature, read_estimates, write_estimates
from drogue_models.marker_layout import marker_layout
from droguekit.scoring.report.number_text import ABSENT
from studies.paper.paper_tables import semi_physical_claims, table_2, worst_station
from studies.paper.semi_physical import read_semi_physical

WriteEstimates = Callable[..., Path]


def test_means_are_those_that_were_put_in(bench: Path, estimates_of: WriteEstimates) -> None:
    path = estimates_of(bench, {"joint-hub": (-0.001, 0.002, 0.01), "paper": (0.0, 0.0, 0.0)}, {"paper": (1,)})
    run = read_semi_physical(bench, path)
    assert run.markers == 7
    np.testing.assert_array_equal(run.stations_m, np.arange(2.0, 11.0))
    ours, paper = run.methods["joint-hub"], run.methods["paper"]
    # A pair at each of the first three stations; the others have none.
    np.testing.assert_allclose(ours.x_m[:3], 0.001)
    np.testing.assert_allclose(ours.y_m[:3], 0.002)
    assert np.isnan(ours.x_m[3:]).all()
    assert (ours.poses, ours.pairs, paper.poses) == (3, 3, 2)
    assert np.isnan(paper.x_m[1])
    data = Dataset(bench)
    for place in range(3):
        record = data.record(place)
        reading_m, pose = record.frame.rangefinder_reading_m, record.left_from_drogue
        assert reading_m is not None and pose is not None
        true_m = pose.translation_m[2]
        assert ours.z_m[place] == pytest.approx(abs(true_m + 0.01 - reading_m))
        assert ours.z_fraction[place] == pytest.approx(abs(true_m + 0.01 - reading_m) / reading_m)
        assert ours.z_true_fraction[place] == pytest.approx(0.01 / true_m)
    # The nearest station is where 10 mm weigh most.
    assert worst_station(ours.z_true_fraction) == ours.z_true_fraction[0]


def test_a_method_that_knows_the_truth_errs_by_the_reading_alone(bench: Path, estimates_of: WriteEstimates) -> None:
    errors = read_semi_physical(bench, estimates_of(bench, {"joint-hub": (0.0, 0.0, 0.0)})).methods["joint-hub"]
    assert worst_station(errors.z_true_fraction) == 0
    # The recipe's offset of 3 mm, noise of 1 mm and resolution of 1 mm: never beyond 3 + 4 standard deviations + 0.5.
    assert 0 < errors.z_m[0] < 0.0075


def test_the_table_has_the_published_rows_as_printed(bench: Path, estimates_of: WriteEstimates) -> None:
    run = read_semi_physical(bench, estimates_of(bench, {"joint-hub": (-0.001, 0.002, 0.0)}))
    measured, published = table_2([run]).groups
    assert measured.rows[0][1:3] == ["1.00", "2.00"]
    assert published.is_published and [row[0] for row in published.rows] == [
        "Wang's method",
        "Ma's method",
        "Ours-5 Points (the paper's)",
        "Ours-7 Points (the paper's)",
    ]
    assert published.rows[-1][1:4] == ["≤ 40", "≤ 40", "≤ 1.03 %"]
    assert all(len(row) == table_2([run]).width for group in (measured, published) for row in group.rows)


def test_estimates_of_another_drogue_are_refused(bench: Path, estimates_of: WriteEstimates) -> None:
    path = estimates_of(bench, {"paper": (0, 0, 0)})
    feature = '{"eye":"left","index":7,"center_px":[1,1],"cov_px2":[[1,0],[0,1]],"used":true}'
    path.write_text(path.read_text(encoding="utf-8").replace('"features":[]', f'"features":[{feature}]'), "utf-8")
    with pytest.raises(ValueError, match="frame 0: measures marker 7, and the drogue has 7"):
        read_semi_physical(bench, path)


def test_estimates_of_fewer_markers_are_refused(bench: Path, estimates_of: WriteEstimates) -> None:
    """Five markers' names pass for a drogue of seven; where they were measured tells them apart."""
    data = Dataset(bench)

    def measured(index: int, turned: bool) -> tuple[Feature, ...]:
        record = data.record(index)
        pose, layout = record.left_from_drogue, marker_layout(record.frame.drogue)
        assert pose is not None
        step = 2 * np.pi / 5 if turned else 2 * np.pi / 7
        angles = np.arange(5) * step + np.arctan2(*layout.centers_m[0, 1::-1])
        radius, depth = np.hypot(*layout.centers_m[0, :2]), layout.centers_m[0, 2]
        points = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(5, depth)], axis=1)
        centers = record.frame.rig.image(pose.apply(points), "left")
        return tuple(
            Feature(eye="left", index=k, center_px=(u, v), cov_px2=((1, 0), (0, 1)), used=True)
            for k, (u, v) in enumerate(centers.tolist())
        )

    path = estimates_of(bench, {"paper": (0, 0, 0)})
    plain = list(read_estimates(path))
    write_estimates(path, [e.model_copy(update={"features": measured(e.frame_index, False)}) for e in plain])
    assert read_semi_physical(bench, path).markers == 7
    write_estimates(path, [e.model_copy(update={"features": measured(e.frame_index, True)}) for e in plain])
    with pytest.raises(ValueError, match=r"half of the measured markers lie .* beside any of the drogue's 7; give the"):
        read_semi_physical(bench, path)


def test_stations_without_a_pose_are_told(bench: Path, estimates_of: WriteEstimates) -> None:
    """The worst station is the worst of those with a pose, however few these are."""
    run = read_semi_physical(bench, estimates_of(bench, {"joint-hub": (0.001, 0, 0)}, {"joint-hub": (0, 1)}))
    table = table_2([run])
    row = dict(zip([table.second, *table.columns], table.groups[0].rows[0], strict=True))
    assert (row["poses"], row["stations"]) == ("1 of 3", "1 of 9")
    claims = list(semi_physical_claims([run]))
    assert len(claims) == 2
    for claim in claims:
        assert claim.ours.endswith("; poses in 1 of 3 pairs, at 1 of 9 stations") and claim.rebuilt == ABSENT
        assert "semi-physical-7, analytic" in claim.what


def test_other_datasets_are_refused(docking: Path, estimates_of: WriteEstimates) -> None:
    with pytest.raises(ValueError, match="its recipe has no stations"):
        read_semi_physical(docking, estimates_of(docking, {"paper": (0, 0, 0)}))
