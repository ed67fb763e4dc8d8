from __future__ import annotations

from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drogue_models.meshes import drogue_meshes, example_body
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.parts import Part
from drogue_models.presets import drogue_text, load_drogue, preset_names

RING = 'name = "mine"\nmarker_count = 6\nmarker_ring_radius_m = 0.27\n'


def write_toml(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def tube(length_m: float = 0.3) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius=0.1, height=length_m, sections=24)
    mesh.apply_translation([0.0, 0.0, 0.26 + length_m / 2])
    return mesh


@pytest.mark.parametrize("name", ["seven-markers", "funnel"])
def test_shipped_examples_load_and_are_closed(name: str) -> None:
    with as_file(files("drogue_models") / "examples") as folder:
        drogue = load_drogue(f"{name}.toml", folder)
        meshes = drogue_meshes(drogue)
    assert drogue.name == name
    for part, mesh in meshes.items():
        assert mesh.is_watertight and mesh.volume > 0, part
        assert mesh.bounds[0][2] >= -1e-9


def test_shipped_body_is_what_its_call_makes() -> None:
    with as_file(files("drogue_models") / "examples" / "funnel-body.ply") as path:
        shipped = trimesh.load_mesh(path, process=False)
    made = example_body()
    np.testing.assert_array_equal(shipped.faces, made.faces)
    # The file holds float32: half a unit in the last place of 0.4 m is 1.5e-8.
    np.testing.assert_allclose(shipped.vertices, made.vertices, rtol=0, atol=2e-8)


def test_short_form_of_a_ring(tmp_path: Path) -> None:
    drogue = load_drogue(write_toml(tmp_path, RING))
    assert drogue == DrogueParameters(name="mine", marker_positions_m=even_ring(6, 0.27))


@pytest.mark.parametrize("name", preset_names())
def test_a_drogue_written_as_text_is_read_back(name: str, tmp_path: Path) -> None:
    drogue = load_drogue(name).model_copy(update={"name": "mine"})
    assert load_drogue(write_toml(tmp_path, drogue_text(drogue))) == drogue


def test_long_form_of_the_positions(tmp_path: Path) -> None:
    text = 'name = "mine"\nmarker_positions_m = [[0.27, 0.0], [0.0, 0.27], [-0.27, 0]]\n'
    assert load_drogue(write_toml(tmp_path, text)).marker_positions_m == ((0.27, 0.0), (0.0, 0.27), (-0.27, 0.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (RING + "marker_radius = 0.05\n", "marker_radius: Extra inputs are not permitted"),
        (RING.replace("6", "24"), "marker_positions_m: markers 0 and 1 overlap"),
        (RING.replace("0.27", "0.29"), "marker_positions_m: marker 0 must lie on the face"),
        (RING.replace("6", "2"), "marker_count: must be a whole number from 3 to 32, got 2"),
        (RING.replace("6", "6.0"), "marker_count: must be a whole number"),
        (RING.replace("marker_count = 6", ""), "marker_count: must be a whole number from 3 to 32, got None"),
        (RING.replace("0.27", "nan"), "marker_ring_radius_m: must be a number above 0"),
        (RING + "marker_positions_m = [[0.27, 0.0]]\n", "marker_positions_m: leave it out"),
        ('name = "mine"\n', "marker_positions_m: Field required"),
        (RING + "rim_radius_m = nan\n", "rim_radius_m: "),
        (RING + "rim_radius_m = -1\n", "rim_radius_m: Input should be greater than 0, got -1"),
        (RING + "face_inner_radius_m = 0.33\n", "face_inner_radius_m: must be below 0.324 m"),
        (RING + "coupling_radius_m = 0.22\n", "coupling_radius_m: must be below face_inner_radius_m"),
        (RING + "coupling_radius_m = 0.07\n", "coupling_radius_m: must exceed the hub's outer radius"),
        (RING + "hose_radius_m = 0.09\n", "hose_radius_m: must be below coupling_radius_m"),
        (RING + "[hub]\ndepth_m = 0.01\n", "hub.depth_m: must exceed the rim's thickness, 0.012 m"),
        (RING + "[hub]\ninner_radius_m = 0.08\n", "hub: inner_radius_m: must be below outer_radius_m"),
        (RING + "[hub]\ncolour = 1\n", "hub.colour: Extra inputs are not permitted"),
        (
            RING + "marker_luminance_cd_m2 = 100.0\nmarker_emission_rgb = [0, 0, 0]\n",
            "marker_emission_rgb: markers that are lit need a colour above 0",
        ),
        ('name = "mine"\nmarker_rings = 5\n', "marker_rings: Input should be a valid tuple"),
        (
            'name = "mine"\nmarker_rings = [{ count = 6, radius_m = -1 }]\n',
            "marker_rings: 0.radius_m: Input should be greater than 0, got -1",
        ),
        (RING + "body_mesh = 3\n", "body_mesh: must be the path of a mesh file, got 3"),
        (RING + 'body_mesh = "none.ply"\n', "body_mesh: .*none.ply cannot be read: No such file or directory"),
        ("name = \n", "not valid TOML"),
    ],
)
def test_faults_name_the_file_and_the_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_drogue(write_toml(tmp_path, text))
    assert "mine.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_unknown_presets_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no preset named 'red-9'; there are red-8"):
        load_drogue("red-9")
    with pytest.raises(ValueError, match=r"none\.toml: cannot be read: No such file"):
        load_drogue("none.toml", tmp_path)


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_body_mesh_replaces_canopy_ribs_and_coupling(tmp_path: Path, suffix: str) -> None:
    tube().export(tmp_path / f"body.{suffix}")
    drogue = load_drogue(write_toml(tmp_path, RING + f'body_mesh = "body.{suffix}"\n'))
    meshes = drogue_meshes(drogue)
    assert int(Part.CANOPY) not in meshes and int(Part.RIBS) not in meshes
    bounds = meshes[int(Part.COUPLING)].bounds
    # The files hold float32 or eight decimals. The hub's holder begins before the tube.
    np.testing.assert_allclose(bounds[:, :2], tube().bounds[:, :2], rtol=0, atol=1e-7)
    assert bounds[:, 2] == pytest.approx([drogue.hub_depth_m, 0.56], abs=1e-7)
    assert {int(Part.FACE), int(Part.RIM), int(Part.HUB)} <= set(meshes)


def test_stored_drogue_pins_the_mesh_but_not_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tube().export(tmp_path / "body.ply")
    drogue = load_drogue(write_toml(tmp_path, RING + 'body_mesh = "body.ply"\n'))
    stored = drogue.model_dump_json()
    assert str(tmp_path) not in stored
    again = DrogueParameters.model_validate_json(stored)
    assert again == drogue and again.model_dump() == drogue.model_dump()
    with pytest.raises(ValueError, match=r"body_mesh: body\.ply cannot be read: .*meshes, .*working directory"):
        drogue_meshes(again)
    monkeypatch.chdir(tmp_path)
    assert int(Part.COUPLING) in drogue_meshes(again)


def test_changed_mesh_is_refused(tmp_path: Path) -> None:
    tube().export(tmp_path / "body.ply")
    drogue = load_drogue(write_toml(tmp_path, RING + 'body_mesh = "body.ply"\n'))
    tube(0.31).export(tmp_path / "body.ply")
    with pytest.raises(ValueError, match=r"body_mesh: .*body\.ply has changed since the drogue was loaded"):
        drogue_meshes(drogue)


def _open(mesh: trimesh.Trimesh) -> None:
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)


def _not_finite(mesh: trimesh.Trimesh) -> None:
    mesh.vertices[0, 0] = np.nan


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_open, "must be closed"),
        (_not_finite, "not finite"),
        (lambda mesh: mesh.invert(), "must have its normals outwards"),
        (lambda mesh: mesh.apply_scale(1000.0), "coordinates in metres, got 300"),
        (lambda mesh: mesh.apply_scale(0.001), "coordinates in metres, got 0.0003"),
        (lambda mesh: mesh.apply_translation([0.0, 0.0, -0.3]), "behind the rim plane .* got z down to -0.04 m"),
        (lambda mesh: mesh.apply_translation([0.24, 0.0, 0.0]), "within rim_radius_m, 0.33 m, .* got 0.34 m; make"),
    ],
)
def test_unfit_meshes_are_refused(tmp_path: Path, spoil: Callable[[trimesh.Trimesh], object], message: str) -> None:
    mesh = tube()
    spoil(mesh)
    mesh.export(tmp_path / "body.ply")
    drogue = load_drogue(write_toml(tmp_path, RING + 'body_mesh = "body.ply"\n'))
    with pytest.raises(ValueError, match=f"body_mesh: .*body.ply .*{message}") as caught:
        drogue_meshes(drogue)
    assert "\n" not in str(caught.value)


def ball(radius_m: float, x_m: float, z_m: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(radius=radius_m, subdivisions=2)
    mesh.apply_translation([x_m, 0.0, z_m])
    return mesh


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.invert()
    return mesh


def disc(radius_m: float, z_m: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius=radius_m, height=0.002, sections=24)
    mesh.apply_translation([0.0, 0.0, z_m])
    return mesh


def doubled_sheet() -> trimesh.Trimesh:
    corners_m = [[0.2, 0.0, 0.1], [0.2, 0.03, 0.1], [0.2, 0.0, 0.13]]
    return trimesh.Trimesh(corners_m, [[0, 1, 2], [0, 2, 1]], process=False)


def meshes_with(folder: Path, *pieces: trimesh.Trimesh) -> dict[int, trimesh.Trimesh]:
    trimesh.util.concatenate([tube(), *pieces]).export(folder / "body.ply")
    return drogue_meshes(load_drogue(write_toml(folder, RING + 'body_mesh = "body.ply"\n')))


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        # Its volume is less than the tube's, so that the whole has a positive one.
        (inside_out(ball(0.05, 0.2, 0.1)), r"the piece of 320 triangles around \(0\.2, .*, 0\.1\) m is inside out"),
        # Half of it sticks out of the tube.
        (inside_out(ball(0.05, 0.1, 0.4)), "is inside out"),
        (
            doubled_sheet(),
            r"must enclose a volume, but the piece of 2 triangles around \(0\.2, .*, 0\.1\d*\) m does not",
        ),
        # Neither a corner nor an edge of its triangles is over the face or the hub: only their inside is.
        (disc(0.329, 0.002), r"must lie behind the face, .* z = 0\.005 m, between 0\.21 and 0\.324 m"),
        (disc(0.2, 0.1), r"must lie behind the hub's face, z = 0\.25 m, within 0\.075 m"),
        # As far forward as the hub's face is too far: the two would flicker.
        (disc(0.05, 0.251), "must lie behind the hub's face"),
        (ball(0.01, 0.27, 0.012), "must lie behind the face"),
    ],
)
def test_pieces_that_are_drawn_wrong_or_cover_the_features_are_refused(
    tmp_path: Path, piece: trimesh.Trimesh, message: str
) -> None:
    with pytest.raises(ValueError, match=f"body_mesh: .*body.ply .*{message}"):
        meshes_with(tmp_path, piece)


def test_pieces_beside_the_features_and_cavities_are_taken(tmp_path: Path) -> None:
    cavity = inside_out(ball(0.05, 0.0, 0.4))
    within_the_mouth, behind_the_face = ball(0.01, 0.15, 0.02), ball(0.01, 0.27, 0.016)
    body = meshes_with(tmp_path, cavity, within_the_mouth, behind_the_face)[int(Part.COUPLING)]
    assert body.is_watertight and body.body_count == 5


def test_a_hub_in_a_mesh_shows_nothing_but_its_front(tmp_path: Path) -> None:
    meshes = meshes_with(tmp_path)
    hub, body = meshes[int(Part.HUB)], meshes[int(Part.COUPLING)]
    walls = hub.vertices[hub.vertices[:, 2] > hub.bounds[0, 2]]
    # The holder around it is as deep, and a wall of it lies on each of the annulus.
    holder = max(body.split(), key=lambda piece: -piece.bounds[0, 2])
    assert holder.bounds[0, 2] == hub.bounds[0, 2] and holder.bounds[1, 2] > walls[:, 2].max()
    radii = np.hypot(*holder.vertices[:, :2].T)
    for radius in np.unique(np.hypot(*hub.vertices[:, :2].T).round(9)):
        assert np.abs(radii - radius).min() < 1e-9
    assert radii.min() < np.hypot(*hub.vertices[:, :2].T).min() and radii.max() == pytest.approx(0.081, abs=1e-4)


@pytest.mark.parametrize("part", ["canopy", "ribs"])
def test_satin_on_parts_that_a_mesh_replaces_is_refused(tmp_path: Path, part: str) -> None:
    tube().export(tmp_path / "body.ply")
    text = RING + 'body_mesh = "body.ply"\nsatin = { parts = ["coupling"] }\n'
    assert load_drogue(write_toml(tmp_path, text)).satin is not None
    with pytest.raises(ValueError, match=r'satin\.parts: must be \["coupling"\] beside body_mesh'):
        load_drogue(write_toml(tmp_path, text.replace('"coupling"', f'"coupling", "{part}"')))


def test_a_mesh_may_be_as_wide_as_the_rim(tmp_path: Path) -> None:
    tube().apply_scale([3.3, 3.3, 1.0]).export(tmp_path / "body.stl")
    meshes = drogue_meshes(load_drogue(write_toml(tmp_path, RING + 'body_mesh = "body.stl"\n')))
    assert meshes[int(Part.COUPLING)].bounds[1][0] == pytest.approx(0.33, abs=1e-7)  # float32


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("body.ply", b"not a mesh", "cannot be read as ply"),
        ("body.txt", b"x", "of a kind that cannot be read; use one of .*ply"),
        ("body.zip", b"PK", "of a kind that cannot be read; use one of dxf, glb"),
        ("body.bz2", b"BZh", "of a kind that cannot be read; use one of dxf, glb"),
        ("body.stl", b"solid empty\nendsolid empty\n", "body.stl"),
    ],
)
def test_files_that_are_no_meshes_are_refused(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    drogue = load_drogue(write_toml(tmp_path, RING + f'body_mesh = "{name}"\n'))
    with pytest.raises(ValueError, match=f"body_mesh: .*{message}"):
        drogue_meshes(drogue)


LAMPS = RING + "marker_radius_m = 0.01\nmarker_luminance_cd_m2 = 20000\n"


def code(*patterns: str) -> str:
    return f"[marker_code]\nslot_s = 0.1\npatterns = {list(patterns)}\n"


def test_lamps_shine_for_the_share_of_an_exposure_in_which_their_slot_is_lit(tmp_path: Path) -> None:
    patterns = ("10", "01", "1", "110", "1000", "011")
    drogue = load_drogue(write_toml(tmp_path, LAMPS + code(*patterns)))
    # Time zero is the middle of the first slot, whole rounds later too.
    for time_s in (0.0, 1.2, -2.4, 1.2e9):
        assert drogue.lit_fractions(time_s, 0.01) == (1, 0, 1, 1, 1, 0)
    # Half of the exposure in the first slot, half in the second.
    assert drogue.lit_fractions(0.05, 0.02) == (0.5, 0.5, 1, 1, 0.5, 0.5)
    # Over many rounds the share is that of the pattern.
    shares = drogue.lit_fractions(0.3, 12.0)
    assert shares == pytest.approx([pattern.count("1") / len(pattern) for pattern in patterns], abs=1e-9)
    # Against a sum over many instants.
    instants = np.linspace(0.23 - 0.135, 0.23 + 0.135, 20001)
    counted = np.mean([drogue.lit_fractions(float(time_s), 0.0) for time_s in instants], axis=0)
    assert drogue.lit_fractions(0.23, 0.27) == pytest.approx(counted, abs=1e-3)


def test_one_pattern_is_that_of_all_lamps_and_others_must_fit(tmp_path: Path) -> None:
    assert load_drogue(write_toml(tmp_path, LAMPS + code("01"))).lit_fractions(0.0, 0.01) == (0,) * 6
    assert load_drogue(write_toml(tmp_path, LAMPS)).lit_fractions(0.0, 0.01) == (1,) * 6
    with pytest.raises(ValueError, match=r"marker_code.patterns: must be 6, or one for all, got 2"):
        load_drogue(write_toml(tmp_path, LAMPS + code("01", "10")))
    with pytest.raises(ValueError, match=r"marker_code: only lamps blink"):
        load_drogue(write_toml(tmp_path, RING + code("01")))
    with pytest.raises(ValueError, match=r"marker_code.patterns.0"):
        load_drogue(write_toml(tmp_path, LAMPS + code("00")))
