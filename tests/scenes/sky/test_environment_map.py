"""A user's own map: read, scaled, turned, its sun taken out, and pinned by its contents."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from datasets_manifest.recipe.recipe import Recipe, load_recipe
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.frame import FrameSpec
from labelgen.frame_labels import label_frame
from render.camera.sensor import expose
from render.engine import load_engine
from scenes.environment_radiance import environment_radiance, sun_elevation_deg
from scenes.sampler import sample_frame
from scenes.sky.equirectangular_sky import load_map
from scenes.sky.photometry import SUN_SOLID_ANGLE_SR, luminance
from tests.support.recipe_builder import RecipeTable, recipe_text, stations

HEIGHT = 128
BASE: RecipeTable = {
    "name": "map-test",
    "frames": {"count": 4},
    "distance": stations(10.0),
    "exposure": {"time_s": 1e-3},
}


def picture(sun_row: int = 40, sun_column: int = 180, sun: float = 50_000.0) -> np.ndarray:
    """Sky of 1 over ground of 0.25, redder to the right of the middle, and a sun of one texel."""
    values = np.ones((HEIGHT, 2 * HEIGHT, 3), dtype=np.float32)
    values[HEIGHT // 2 :] = 0.25
    values[:, HEIGHT:, 0] *= 2.0
    if sun:
        values[sun_row, sun_column] = sun
    return values


def write(path: Path, values: np.ndarray) -> None:
    if path.suffix == ".hdr":
        cv2.imwrite(str(path), values[..., ::-1])
    else:
        channels = {name: np.ascontiguousarray(values[..., index]) for index, name in enumerate("RGB")}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


def recipe(folder: Path, name: str = "sky.exr", scenes: int = 1, **keys: float | list[float]) -> Recipe:
    """A recipe in a file beside the map, with these keys for the map; 1000 cd/m2 a unit without any."""
    path = folder / "mine.toml"
    environment_map = {"file": name, **(keys or {"cd_m2_per_unit": 1000.0})}
    text = recipe_text(BASE, frames={"scenes": scenes}, environment={"map": environment_map})
    path.write_text(text, encoding="utf-8")
    return load_recipe(str(path)).recipe


def environment(folder: Path, name: str = "sky.exr", **keys: float | list[float]) -> Environment:
    return sample_frame(recipe(folder, name, **keys), 0).environment


def texel_direction(row: int, column: int, rotation_deg: float = 0.0) -> np.ndarray:
    polar, azimuth = (row + 0.5) * np.pi / HEIGHT, np.radians(rotation_deg) - (column + 0.5 - HEIGHT) * np.pi / HEIGHT
    return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


@pytest.mark.parametrize(("name", "tolerance"), [("sky.exr", 1e-6), ("sky.hdr", 0.01)])
def test_levels_colours_and_sides_are_kept(tmp_path: Path, name: str, tolerance: float) -> None:
    """Radiance files keep eight bits of mantissa: 0.4 % of the largest channel."""
    write(tmp_path / name, picture(sun=0))
    around = environment_radiance(environment(tmp_path, name))
    right = around.radiance(texel_direction(30, HEIGHT + 20)[None, None].astype(np.float32))[0, 0]
    left = around.radiance(texel_direction(30, HEIGHT - 20)[None, None].astype(np.float32))[0, 0]
    np.testing.assert_allclose(right, [2000, 1000, 1000], rtol=tolerance)
    np.testing.assert_allclose(left, [1000, 1000, 1000], rtol=tolerance)
    # Right of a camera that looks east is south.
    assert texel_direction(30, HEIGHT + 20)[1] < 0


def test_the_sun_becomes_a_beam_of_the_same_light(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    light = load_map(environment(tmp_path, cd_m2_per_unit=1000.0, rotation_deg=30).map)
    edges = np.cos(np.array([40, 41]) * np.pi / HEIGHT)
    solid_angle_sr = (edges[0] - edges[1]) * np.pi / HEIGHT
    np.testing.assert_allclose(light.sun_lux, (50e6 - np.array([2e3, 1e3, 1e3])) * solid_angle_sr, rtol=1e-5)
    np.testing.assert_allclose(light.sun_direction, texel_direction(40, 180, 30.0), atol=1e-6)
    assert light.image.max() == 2000


def test_the_disc_is_drawn_where_the_sun_was(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    around = environment_radiance(environment(tmp_path))
    directions = around.beam_direction[None, None].astype(np.float32)
    seen = np.zeros((1, 1, 3), dtype=np.float32)
    around.add_discs(seen, directions)
    np.testing.assert_allclose(seen[0, 0], around.beam_illuminance_lux / SUN_SOLID_ANGLE_SR, rtol=1e-6)


def test_an_even_sky_has_no_sun(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture(sun=0))
    sunless = environment(tmp_path)
    assert load_map(sunless.map).sun_lux.max() == 0
    assert sun_elevation_deg(sunless) is None
    assert sun_elevation_deg(sunless.model_copy(update={"map": None})) == sunless.sun_elevation_deg


@pytest.mark.parametrize("sun", [0.0, 50_000.0])
def test_records_tell_the_elevation_of_a_sun_that_a_map_shows(tmp_path: Path, sun: float) -> None:
    write(tmp_path / "sky.exr", picture(sun=sun))
    drawn = recipe(tmp_path)
    frame = sample_frame(drawn, 0)
    light = load_engine("analytic").render(frame, drawn.render)
    record = label_frame(frame, light, expose(frame, light))
    elevation_deg = record.conditions.sun_elevation_deg
    if sun:
        assert elevation_deg == pytest.approx(90 - 40.5 * 180 / HEIGHT, abs=1e-4)  # float32
    else:
        assert elevation_deg is None
    text = record.model_dump_json()
    assert type(record).model_validate_json(text).model_dump_json() == text


def test_illuminance_is_as_asked_for(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    around = environment_radiance(environment(tmp_path, horizontal_illuminance_lux=70000))
    # The light map has 128 rows, as this picture: only the split of the sun's texel among cosines is left.
    assert float(luminance(around.ground_illuminance_lux)) == pytest.approx(70_000, rel=0.01)


def test_rotations_are_drawn_by_scene(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    drawn = recipe(tmp_path, scenes=4, cd_m2_per_unit=1.0, rotation_deg=[0, 360])
    environments = [sample_frame(drawn, index).environment for index in range(4)]
    assert len({env.map.rotation_deg for env in environments}) == 4
    assert len({round(env.sun_azimuth_deg, 6) for env in environments}) == 4
    np.testing.assert_allclose([env.sun_elevation_deg for env in environments], 90 - 40.5 * 180 / HEIGHT, atol=1e-4)


def test_a_frame_works_in_another_process(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    frame = sample_frame(recipe(tmp_path), 1)
    # The frame is stored without the folder: it is looked for where the process runs.
    (tmp_path / "frame.json").write_text(frame.model_dump_json(), encoding="utf-8")
    code = (
        "from pathlib import Path; import numpy as np\n"
        "from datasets_manifest.types.frame import FrameSpec\n"
        "from scenes.environment_radiance import environment_radiance\n"
        "frame = FrameSpec.model_validate_json(Path('frame.json').read_text())\n"
        "print(environment_radiance(frame.environment).light_map.mean(dtype=np.float64))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    here = environment_radiance(frame.environment).light_map.mean(dtype=np.float64)
    assert float(result.stdout) == pytest.approx(here, rel=1e-6)
    assert str(tmp_path) not in frame.model_dump_json()
    assert FrameSpec.model_validate_json(frame.model_dump_json()).environment.map.sha256 == frame.environment.map.sha256


def test_a_changed_file_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "sky.exr", picture())
    drawn = recipe(tmp_path)
    write(tmp_path / "sky.exr", picture(sun=0))
    with pytest.raises(ValueError, match=r"environment\.map: .*sky\.exr has changed .* restore the file"):
        sample_frame(drawn, 0)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"environment\.map: .*sky\.exr cannot be read: No such file"):
        recipe(tmp_path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones((32, 48, 3), dtype=np.float32), "must be twice as wide as high"),
        (np.full((32, 64, 3), np.inf, dtype=np.float32), "holds infinite or undefined values"),
        (np.zeros((32, 64, 3), dtype=np.float32), "is black"),
    ],
)
def test_wrong_pictures_are_refused(tmp_path: Path, values: np.ndarray, message: str) -> None:
    write(tmp_path / "sky.exr", values)
    with pytest.raises(ValueError, match=message):
        environment(tmp_path)


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    for name in ("sky.exr", "sky.hdr"):
        (tmp_path / name).write_bytes(b"no picture")
        with pytest.raises(ValueError, match="cannot be read as"):
            environment(tmp_path, name)


def test_a_picture_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sky.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 50000 +X 100000\n" + bytes(64))
    with pytest.raises(ValueError, match=r"sky\.hdr must have 1 to 150000000 pixels, got 50000 x 100000"):
        environment(tmp_path, "sky.hdr")


@pytest.mark.parametrize(
    ("name", "keys", "message"),
    [
        ("sky.png", {"cd_m2_per_unit": 1.0}, "must be the path of an .exr or .hdr file"),
        ("sky.exr", {"rotation_deg": 0}, "give one of the two"),
        ("sky.exr", {"cd_m2_per_unit": 1.0, "horizontal_illuminance_lux": 1.0}, "give one of the two"),
        ("sky.exr", {"cd_m2_per_unit": 1.0, "turn": 3}, "turn: Extra inputs"),
    ],
)
def test_wrong_keys_are_named(tmp_path: Path, name: str, keys: dict[str, float], message: str) -> None:
    write(tmp_path / "sky.exr", picture())
    with pytest.raises(ValueError, match=message):
        recipe(tmp_path, name, **keys)
