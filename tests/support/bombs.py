"""The worst files of at most a megabyte for each reader; `tests.support.peak_memory` measures what each takes."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from onnx import TensorProto, helper
from PIL import Image

from datasets_manifest.calibration.calibration_reader import read_calibration
from datasets_manifest.importers.coco_boxes import read_boxes
from datasets_manifest.importers.image_files import read_image
from datasets_manifest.importers.ros_bag import RosBag
from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.recipe.rigs import load_rig
from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.frame_store import index_of_archive, list_frames
from datasets_manifest.storage.image_codecs import decode_exr, decode_png
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import read_estimates
from drogue_models.drogue_families.user_meshes import load_body_mesh
from drogue_models.presets import load_drogue
from droguekit.scoring.results.detection_result import read_detections
from geometry.pinhole import PinholeCamera
from labelgen.validation.dataset_checks import validate_dataset
from nav.detector.onnx_detector import OnnxDetector
from nav.training.training_settings import build_settings
from nav.training.training_state import read_starting_weights
from scenes.sky.equirectangular_sky import load_map
from tests.support.bag_bombs import BAGS, MOST_BYTES
from tests.support.recipe_builder import recipe_text
from tests.support.whole_dataset import write_whole_dataset

_MIB, _GIB = 2**20, 2**30


class Bomb(NamedTuple):
    """A hostile file: how it is written into a folder, and how it is read."""

    write: Callable[[Path], Path]
    read: Callable[[Path], object]


def _file(name: str, data: Callable[[], bytes]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(data())
        return path

    return write


def _repeated(item: str, head: str = "[", tail: str = "]") -> bytes:
    count = (MOST_BYTES - len(head) - len(tail)) // (len(item) + 1)
    return (head + ",".join([item] * count) + tail).encode()


def _numbered(item: str, head: str, tail: str, sep: str = ",") -> bytes:
    """Items in which `@` stands for their number."""
    count = (MOST_BYTES - len(head) - len(tail)) // (len(item) + 5 + len(sep))
    return (head + sep.join(item.replace("@", str(place)) for place in range(count)) + tail).encode()


_WIDE: dict[str, Callable[[str, str], bytes]] = {
    "lists": lambda head, tail: _repeated("[]", f"{head}[", f"]{tail}"),
    "objects": lambda head, tail: _repeated("{}", f"{head}[", f"]{tail}"),
    "keys": lambda head, tail: _numbered('"@":0', f"{head}{{", f"}}{tail}"),
    "text": lambda head, tail: f'{head}"{"x" * (MOST_BYTES - 2 - len(head + tail))}"{tail}'.encode(),
}


def _within(table: Any, place: Iterable[str | int], kind: str) -> bytes:
    """A JSON table whose value at a place is replaced by a wide one."""
    node, (*steps, last) = table, [*place]
    for step in steps:
        node = node[step]
    node[last] = "@HERE@"
    head, tail = json.dumps(table).split('"@HERE@"')
    return _WIDE[kind](head, tail)


def _dataset(name: str, place: tuple[str | int, ...], kind: str) -> Callable[[Path], Path]:
    """A whole dataset of which one file is wide at a place; an empty place means all of the file."""

    def write(folder: Path) -> Path:
        dataset = folder / "dataset"
        write_whole_dataset(dataset)
        file = dataset / name
        file.parent.mkdir(exist_ok=True)
        table = json.loads(file.read_bytes()) if file.exists() and place else {}
        file.write_bytes(_within(table, place, kind) if place else _WIDE[kind]("", ""))
        return dataset

    return write


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _zeros_deflated(size: int) -> bytes:
    packer = zlib.compressobj(9)
    parts = [packer.compress(bytes(_MIB)) for _ in range(size // _MIB + 1)]
    return b"".join([*parts, packer.flush()])


def _png(size_px: tuple[int, int], bits: int, color: int, samples: int) -> bytes:
    data = _zeros_deflated(size_px[1] * (1 + size_px[0] * samples * bits // 8))
    head = struct.pack(">IIBBBBB", *size_px, bits, color, 0, 0, 0)
    palette = _png_chunk(b"PLTE", bytes(768)) + _png_chunk(b"tRNS", bytes(256)) if color == 3 else b""
    parts = _png_chunk(b"IHDR", head) + palette + _png_chunk(b"IDAT", data) + _png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def _read_png(path: Path) -> object:
    data = path.read_bytes()
    width_px, height_px = struct.unpack_from(">II", data, 16)
    return decode_png(data, str(path), PinholeCamera(width_px, height_px, 1e3, 1e3, width_px / 2, height_px / 2))


def _picture(kind: str, size_px: tuple[int, int], mode: str, **options: Any) -> Bomb:
    def data() -> bytes:
        stream = io.BytesIO()
        Image.new(mode, size_px).save(stream, kind, **options)
        return stream.getvalue()

    return Bomb(_file("picture.jpg", data), read_image)


def _exr(size_px: tuple[int, int], stated_px: tuple[int, int] | None = None) -> bytes:
    import OpenEXR

    path = Path(f"/dev/shm/bomb-{os.getpid()}.exr")
    try:
        planes = {name: np.zeros(size_px[::-1], np.float32) for name in "RGB"}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, planes).write(str(path))
        data = path.read_bytes()
    finally:
        path.unlink(missing_ok=True)
    window, stated = (struct.pack("<ii", side[0] - 1, side[1] - 1) for side in (size_px, stated_px or size_px))
    return data.replace(window, stated)


def _hdr() -> bytes:
    width_px, height_px = 8192, 2600
    row = b"\2\2" + struct.pack(">H", width_px) + (b"\xff\0" * (width_px // 127) + bytes([128 + width_px % 127, 0])) * 4
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height_px} +X {width_px}\n".encode()
    return (head + row * height_px)[:MOST_BYTES]


def _read_map(path: Path) -> object:
    recipe = path.with_name("recipe.toml")
    recipe.write_text(recipe_text(environment={"map": path.name}))
    light = load_recipe(str(recipe)).recipe.environment.map
    assert light is not None
    return load_map(light)


def _read_mesh(path: Path) -> object:
    drogue = path.with_name("drogue.toml")
    drogue.write_text(f'name = "own"\nmarker_count = 8\nmarker_ring_radius_m = 0.27\nbody_mesh = "{path.name}"\n')
    return load_body_mesh(load_drogue(str(drogue)))


def _gltf(count: int) -> bytes:
    accessors = [
        {"componentType": kind, "count": count, "type": name} for kind, name in ((5126, "VEC3"), (5125, "SCALAR"))
    ]
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}
    table = {"asset": {"version": "2.0"}, "accessors": accessors, "meshes": [mesh], "nodes": [{"mesh": 0}]}
    return json.dumps(table | {"scenes": [{"nodes": [0]}], "scene": 0}).encode()


def _ply(count: int) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    head += "property float x\nproperty float y\nproperty float z\nelement face 1\n"
    return (head + "property list uchar int vertex_indices\nend_header\n").encode() + bytes(MOST_BYTES - 300)


def _obj() -> bytes:
    return b"v 0 0 0\n" + b"f 1 1 1\n" * (MOST_BYTES // 8 - 2)


def _opencv_yaml(rows: int) -> bytes:
    matrix = f"!!opencv-matrix\n   rows: {rows}\n   cols: {rows}\n   dt: d\n   data: [ 1., 0. ]\n"
    return f"%YAML:1.0\n---\nM1: {matrix}".encode()


def _network(nodes: list[Any], weights: list[Any] = [], sparse: list[Any] = []) -> bytes:  # noqa: B006
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["b", 3, 64, 96])
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "g", [images], [result], weights)
    graph.sparse_initializer.extend(sparse)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


_SHAPE = helper.make_tensor("s", TensorProto.INT64, [4], [1, 1, 60_000, 60_000])


def _constant_network() -> bytes:
    """Its constant part has 14 GB."""
    nodes = [helper.make_node("ConstantOfShape", ["s"], ["z"]), helper.make_node("ReduceSum", ["z"], ["r"])]
    return _network([*nodes, helper.make_node("Add", ["images", "r"], ["y"])], [_SHAPE])


def _growing_network() -> bytes:
    """Its result has 14 GB."""
    nodes = [helper.make_node("ReduceSum", ["images"], ["r"]), helper.make_node("Expand", ["r", "s"], ["y"])]
    return _network(nodes, [_SHAPE])


def _sparse_network() -> bytes:
    value, place = (
        helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0]),
        helper.make_tensor("i", TensorProto.INT64, [1], [5]),
    )
    weights = helper.make_sparse_tensor(value, place, [60_000, 60_000])
    return _network([helper.make_node("Add", ["images", "w"], ["y"])], sparse=[weights])


def _empty_nodes() -> bytes:
    graph, length = b"\x0a\0" * (MOST_BYTES // 2 - 20), b""
    size = len(graph)
    while size > 127:
        length, size = length + bytes([size & 127 | 128]), size >> 7
    return b"\x08\x08\x3a" + length + bytes([size]) + graph + bytes.fromhex("42021011")


def _checkpoint(pickled: bytes | None, zeros: int = 0) -> bytes:
    """A checkpoint with another pickle, or with a tensor that is compressed."""
    stream, out = io.BytesIO(), io.BytesIO()
    torch.save({"w": torch.zeros(4, dtype=torch.uint8)}, stream)
    method = zipfile.ZIP_DEFLATED if zeros else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream) as archive, zipfile.ZipFile(out, "w", method, compresslevel=9) as changed:
        for name in archive.namelist():
            data = archive.read(name)
            if name.endswith("data.pkl"):
                data = pickled or data.replace(b"K\x04", b"J" + struct.pack("<i", zeros))
            with changed.open(name, "w") as member:
                for _ in range(zeros // _MIB if name.endswith("data/0") else 0):
                    member.write(bytes(_MIB))
                member.write(b"" if zeros and name.endswith("data/0") else data)
    return out.getvalue()


def _tar() -> bytes:
    """An archive that begins with a header of a gigabyte, of which a megabyte is there."""
    import tarfile

    member = tarfile.TarInfo("././@PaxHeader")
    member.type, member.size = tarfile.XHDTYPE, _GIB
    return member.tobuf(tarfile.GNU_FORMAT) + b"9" * (MOST_BYTES - 512)


def _read_bag(path: Path) -> object:
    return [*RosBag(path)]


def _read_archive(path: Path) -> object:
    with path.open("rb") as stream:
        return index_of_archive(stream)


RECORD = "frames/000000/record.json"
_TOML_CHAINS = {"tables": ("[@", "]\n"), "keys": ("@", "=0\n"), "lists of tables": ("[[@", "]]\n")}
_TOML_READERS: dict[str, Callable[[Path], object]] = {
    "recipe": lambda path: load_recipe(str(path)),
    "drogue": lambda path: load_drogue(str(path)),
    "rig": lambda path: load_rig(str(path)),
    "training settings": lambda path: build_settings(path, {}),
}
_RECORD_PLACES: tuple[tuple[str | int, ...], ...] = (
    (),
    ("views", "left", "markers"),
    ("frame", "environment", "clouds"),
    ("frame", "bystanders"),
    ("frame", "drogue", "marker_positions_m"),
)
_MANIFEST_PLACES: tuple[tuple[str | int, ...], ...] = (("frames",), ("drops",), ("recipe", "families"), ("software",))


def _read_record(dataset: Path) -> object:
    return Dataset(dataset).record(0)


BOMBS: dict[str, Bomb] = {
    **{
        f"record {'.'.join(map(str, place))} {kind}": Bomb(_dataset(RECORD, place, kind), _read_record)
        for place in _RECORD_PLACES
        for kind in ("lists", "objects", "keys", "text")
    },
    **{
        f"manifest {'.'.join(map(str, place))} {kind}": Bomb(_dataset("manifest.json", place, kind), read_manifest)
        for place in _MANIFEST_PLACES
        for kind in ("lists", "objects", "keys")
    },
    **{
        f"{name} {kind}": Bomb(_dataset(file, place, kind), read)
        for name, file, place, read in (
            ("blind index", "blind.json", (), read_blind_index),
            ("shard layout", "shards/layout.json", (), list_frames),
            ("annotations", "annotations/all.json", (), validate_dataset),
            ("annotations.annotations", "annotations/all.json", ("annotations",), validate_dataset),
            ("annotations.images", "annotations/all.json", ("images",), validate_dataset),
        )
        for kind in ("lists", "objects", "keys")
    },
    **{
        f"{name} {kind}": Bomb(_file("file.json", lambda kind=kind: _WIDE[kind]("", "")), read)
        for name, read in (
            ("estimates", lambda path: [*read_estimates(path)]),
            ("detections", lambda path: read_detections(path, [1])),
            ("boxes", read_boxes),
            ("calibration", lambda path: read_calibration([path])),
        )
        for kind in _WIDE
    },
    **{
        f"{name} {chain}": Bomb(
            _file("file.toml", lambda ends=ends: _numbered(ends[0] + ".a" * 98 + ends[1], "", "", "")), read
        )
        for name, read in _TOML_READERS.items()
        for chain, ends in _TOML_CHAINS.items()
    },
    "drogue rings": Bomb(
        _file("file.toml", lambda: _repeated("{count=32,radius_m=0.3}", "marker_rings=[")), _TOML_READERS["drogue"]
    ),
    "png": Bomb(_file("left.png", lambda: _png((30_000, 30_000), 8, 0, 1)), _read_png),
    "png rgb 8": Bomb(_file("left.png", lambda: _png((8192, 10_900), 8, 2, 3)), _read_png),
    "png rgb 16": Bomb(_file("left.png", lambda: _png((8192, 5400), 16, 2, 3)), _read_png),
    "png grey 16": Bomb(_file("left.png", lambda: _png((8192, 16_300), 16, 0, 1)), _read_png),
    "png palette": Bomb(_file("left.png", lambda: _png((8192, 10_900), 8, 3, 1)), _read_png),
    "image png": Bomb(_file("left.png", lambda: _png((8192, 5400), 16, 2, 3)), read_image),
    "image jpeg": _picture("JPEG", (8192, 16_000), "L", progressive=True, quality=1),
    "image webp": _picture("WEBP", (8192, 5400), "RGB", quality=1),
    "image tiff": _picture("TIFF", (8192, 16_000), "I;16", compression="tiff_deflate"),
    "image jpeg 2000": _picture("JPEG2000", (8192, 5400), "RGB"),
    "image pam": Bomb(
        _file("a.pgm", lambda: b"P7\nWIDTH 30000\nHEIGHT 30000\nDEPTH 3\nMAXVAL 255\nENDHDR\n" + bytes(900_000)),
        read_image,
    ),
    "exr": Bomb(_file("a.exr", lambda: _exr((4096, 5000))), lambda path: decode_exr(path.read_bytes())),
    "exr header": Bomb(
        _file("a.exr", lambda: _exr((64, 64), (100_000, 100_000))), lambda path: decode_exr(path.read_bytes())
    ),
    "map exr": Bomb(_file("map.exr", lambda: _exr((6400, 3200))), _read_map),
    "map hdr": Bomb(_file("map.hdr", _hdr), _read_map),
    "mesh gltf": Bomb(_file("body.gltf", lambda: _gltf(10**9)), _read_mesh),
    "mesh ply": Bomb(_file("body.ply", lambda: _ply(10**9)), _read_mesh),
    "mesh obj": Bomb(_file("body.obj", _obj), _read_mesh),
    "mesh stl": Bomb(_file("body.stl", lambda: bytes(80) + struct.pack("<I", 2**31) + bytes(900_000)), _read_mesh),
    "calibration matrix": Bomb(_file("a.yaml", lambda: _opencv_yaml(100_000)), lambda path: read_calibration([path])),
    "calibration numbers": Bomb(
        _file("a.yaml", lambda: _repeated("1", "%YAML:1.0\n---\nM1: [", "]")),
        lambda path: read_calibration([path]),
    ),
    "calibration yaml": Bomb(_file("a.yaml", lambda: b"- a\n" * 65_000), lambda path: read_calibration([path])),
    "calibration xml": Bomb(
        _file(
            "a.xml", lambda: b'<?xml version="1.0"?><opencv_storage><a>' + b"1 " * 450_000 + b"</a></opencv_storage>"
        ),
        lambda path: read_calibration([path]),
    ),
    **{name: Bomb(write, _read_bag) for name, write in BAGS.items()},
    "onnx constant": Bomb(_file("a.onnx", _constant_network), OnnxDetector),
    "onnx result": Bomb(_file("a.onnx", _growing_network), OnnxDetector),
    "onnx sparse": Bomb(_file("a.onnx", _sparse_network), OnnxDetector),
    "onnx nodes": Bomb(_file("a.onnx", _empty_nodes), OnnxDetector),
    "weights onnx": Bomb(_file("a.onnx", _empty_nodes), lambda path: read_starting_weights(str(path))),
    "checkpoint": Bomb(
        _file("a.pt", lambda: _checkpoint(None, 900 * _MIB)), lambda path: read_starting_weights(str(path))
    ),
    "checkpoint bytes": Bomb(
        _file("a.pt", lambda: _checkpoint(b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.")),
        lambda path: read_starting_weights(str(path)),
    ),
    "checkpoint lists": Bomb(
        _file("a.pt", lambda: _checkpoint(b"\x80\x02(" + b"]" * 900_000 + b"l.")),
        lambda path: read_starting_weights(str(path)),
    ),
    "tar": Bomb(_file("000000.tar", _tar), _read_archive),
}
