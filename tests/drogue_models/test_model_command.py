from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drogue_models.meshes import drogue_meshes
from drogue_models.parts import part_name, part_reflectance_rgb
from drogue_models.presets import PRESETS
from droguekit.cli.main import run

DROGUE = PRESETS["red-5"]


@pytest.fixture(scope="module")
def meshes() -> dict[int, trimesh.Trimesh]:
    return drogue_meshes(DROGUE)


def bounds_m(meshes: dict[int, trimesh.Trimesh]) -> np.ndarray:
    lows, highs = zip(*(mesh.bounds for mesh in meshes.values()), strict=True)
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


@pytest.mark.parametrize("suffix", ["glb", "ply", "stl", "obj"])
def test_written_mesh_reads_back_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], meshes: dict[int, trimesh.Trimesh], suffix: str
) -> None:
    out = tmp_path / f"drogue.{suffix}"
    assert run(["model", "red-5", "--out", str(out)]) == 0
    loaded = trimesh.load_scene(out)
    # Half a unit in the last place of a float32 of 0.45 is 1.5e-8; OBJ writes eight decimals.
    np.testing.assert_allclose(loaded.bounds, bounds_m(meshes), rtol=0, atol=2e-8)
    triangles = sum(len(mesh.faces) for mesh in meshes.values())
    assert sum(len(mesh.faces) for mesh in loaded.geometry.values()) == triangles
    line = capsys.readouterr().out
    assert line.count("\n") == 1
    assert f"{triangles} triangles in {len(meshes)} parts" in line and "z 0.000 to 0.450 m" in line
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


def test_glb_has_a_node_with_its_color_for_every_part(tmp_path: Path, meshes: dict[int, trimesh.Trimesh]) -> None:
    out = tmp_path / "drogue.glb"
    assert run(["model", "red-5", "--out", str(out)]) == 0
    scene = trimesh.load_scene(out)
    assert set(scene.graph.nodes_geometry) == {part_name(part) for part in meshes}
    for part in meshes:
        color = scene.geometry[part_name(part)].visual.material.baseColorFactor
        # trimesh keeps colours in eight bits.
        np.testing.assert_allclose(color[:3] / 255, part_reflectance_rgb(DROGUE, part), rtol=0, atol=0.5 / 255 + 1e-9)


def test_ply_vertices_are_coloured_for_the_eye(tmp_path: Path) -> None:
    out = tmp_path / "drogue.ply"
    assert run(["model", "white-5", "--out", str(out)]) == 0
    colors = {tuple(color) for color in np.asarray(trimesh.load_mesh(out, process=False).visual.vertex_colors)}
    assert (231, 231, 231, 255) in colors, "a linear 0.80 is 231 in sRGB"


def test_same_call_same_bytes(tmp_path: Path) -> None:
    for name in ("a.glb", "b.glb"):
        assert run(["model", "red-5", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["red-5", "--out", "drogue.xyz"], "--out: must end in one of .glb, .ply, .stl, .obj, got 'drogue.xyz'"),
        (["red-9", "--out", "drogue.glb"], "drogue: no preset named 'red-9'"),
        (["none.toml", "--out", "drogue.glb"], "none.toml: cannot be read: No such file or directory"),
        (["red-5", "--out", "none/drogue.glb"], "none/drogue.glb cannot be written: No such file or directory"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["model", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_there_survives_a_failed_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "drogue.stl"
    out.write_bytes(b"old")

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    assert run(["model", "red-5", "--out", str(out)]) == 2
    assert out.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["drogue.stl"]
