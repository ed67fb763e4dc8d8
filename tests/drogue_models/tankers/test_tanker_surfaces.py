from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from drogue_models.tankers.aircraft_paint import SCHEMES
from drogue_models.tankers.atlas import ATLAS_HEIGHT_PX, ATLAS_WIDTH_PX, lay_out
from drogue_models.tankers.planforms import airframe
from drogue_models.tankers.tanker import STATIONS, PaintScheme, Tanker, TankerType
from drogue_models.tankers.tanker_surfaces import tanker_surfaces

SMALL = Tanker(type="multirotor", station="belly", paint="carbon", seed=4)


@pytest.mark.parametrize("name", list(STATIONS))
def test_charts_do_not_overlap_and_have_even_texels(name: TankerType) -> None:
    charts = lay_out(airframe(name, 10.0).grids)
    taken = np.zeros((ATLAS_HEIGHT_PX, ATLAS_WIDTH_PX), dtype=np.int32)
    for chart in charts:
        taken[chart.window] += 1
        assert chart.row + chart.height <= ATLAS_HEIGHT_PX and chart.column + chart.width <= ATLAS_WIDTH_PX
    assert taken.max() == 1
    # A body may be wider than a texel's step by half a texel of rounding.
    large = [chart for chart in charts if min(chart.height, chart.width) > 40]
    per_m = [
        (chart.width / chart.length_m / chart.grid.texel_share, chart.height / chart.girth_m / chart.grid.texel_share)
        for chart in large
    ]
    assert np.ptp(per_m) / np.mean(per_m) < 0.03


def test_texels_lie_where_the_vertices_that_use_them_are() -> None:
    for chart in lay_out(airframe("four-jet", 0.0).grids):
        points, uv = chart.points_m(), chart.uv
        column = np.rint(uv[..., 0] * ATLAS_WIDTH_PX - 0.5).astype(int) - chart.column
        row = np.rint(uv[..., 1] * ATLAS_HEIGHT_PX - 0.5).astype(int) - chart.row
        corners = np.concatenate([chart.grid.points_m, chart.grid.points_m[:, :1]], axis=1)
        texel_m = max(chart.length_m / (chart.width - 1), chart.girth_m / (chart.height - 1))
        # Half a texel along and half across, on a surface whose rings may be far wider or narrower than the mean.
        off_m = np.linalg.norm(points[row, column] - corners, axis=-1)
        assert np.quantile(off_m, 0.9) < 1.5 * texel_m


@pytest.mark.parametrize("paint", list(SCHEMES))
def test_paint_is_possible_and_worn(paint: PaintScheme) -> None:
    surface = tanker_surfaces(Tanker(type="four-turboprop", station="left-pod", paint=paint, seed=1))[0]
    assert surface.has_map and surface.smooth
    # Rounding of float32.
    assert surface.reflectance.min() >= 0.0099 and surface.reflectance.max() <= 0.951
    assert surface.contrast > 0.05


def test_paint_follows_from_the_seed_alone() -> None:
    first, again = tanker_surfaces(SMALL)[0], tanker_surfaces(SMALL.model_copy(update={"nav_lights": False}))[0]
    other = tanker_surfaces(SMALL.model_copy(update={"seed": 5}))[0]
    assert first.reflectance.tobytes() == again.reflectance.tobytes()
    assert first.reflectance.tobytes() != other.reflectance.tobytes()


def test_lamps_shine_in_their_colours_on_their_sides() -> None:
    tanker = Tanker(type="four-jet", station="left-pod", pod_light="green")
    lamps = [surface for surface in tanker_surfaces(tanker) if surface.emission_cd_m2.max() > 0]
    left, right, tail, pod = (
        next(lamp for lamp in lamps if chosen(lamp.emission_cd_m2, lamp.mesh.bounds.mean(axis=0)))
        for chosen in (
            lambda rgb, middle: rgb[0] > 3 * rgb[1],
            lambda rgb, middle: rgb[1] > 3 * rgb[0] and middle[1] > 10,
            lambda rgb, middle: rgb.min() > 0.5 * rgb.max(),
            lambda rgb, middle: rgb[1] > 3 * rgb[0] and abs(middle[1]) < 1,
        )
    )
    # The left pod is 19 m left of the middle and 3 m from the left tip.
    assert left.mesh.bounds.mean(axis=0)[1] == pytest.approx(-3.1, abs=0.3)
    assert right.mesh.bounds.mean(axis=0)[1] == pytest.approx(41.1, abs=0.3)
    assert tail.mesh.bounds.mean(axis=0)[1] == pytest.approx(19.0, abs=0.01)
    assert np.abs(pod.mesh.bounds).max() < 0.3
    dark = tanker_surfaces(tanker.model_copy(update={"nav_lights": False, "pod_light": "off"}))
    assert all(surface.emission_cd_m2.max() == 0 for surface in dark)


def test_the_hose_s_exit_is_the_origin_at_every_station() -> None:
    by_station = {
        station: tanker_surfaces(Tanker(type="twin-jet-wide", station=station))[0].mesh.bounds
        for station in STATIONS["twin-jet-wide"]
    }
    exits = airframe("twin-jet-wide", 0.0).stations_m
    for station, bounds in by_station.items():
        np.testing.assert_allclose(bounds + np.array(exits[station]), by_station["centreline"] + exits["centreline"])


def test_a_station_that_a_type_lacks_is_refused() -> None:
    with pytest.raises(ValidationError, match="station: fighter has buddy-store, got 'left-pod'"):
        Tanker(type="fighter", station="left-pod")
