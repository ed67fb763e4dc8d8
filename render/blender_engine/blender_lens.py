"""Real eyes as a Cycles camera: a shader that gives every place its ray. Only in Blender's own process."""

from __future__ import annotations

import hashlib
import importlib
from functools import lru_cache
from pathlib import Path
from typing import Any

from render.blender_engine.messages import RealEye, Window

# Newton's method doubles the digits with each step; float32 has seven.
_SHADER = """
shader real_eye(output point position = 0.0, output vector direction = 0.0, output color throughput = 1.0)
{{
    point raster = camera_shader_raster_position();
    float seen_x = ({left} - 0.5 + raster.x * {width} - {cx}) / {fx};
    float seen_y = ({top} - 0.5 + (1.0 - raster.y) * {height} - {cy}) / {fy};
    float x = seen_x, y = seen_y;
    for (int step = 0; step < 8; step++) {{
        float r2 = x * x + y * y;
        float radial = 1.0 + r2 * ({k1} + r2 * ({k2} + r2 * {k3}));
        float slope = {k1} + r2 * (2.0 * {k2} + r2 * 3.0 * {k3});
        float off_x = seen_x - (x * radial + 2.0 * {p1} * x * y + {p2} * (r2 + 2.0 * x * x));
        float off_y = seen_y - (y * radial + {p1} * (r2 + 2.0 * y * y) + 2.0 * {p2} * x * y);
        float xx = radial + 2.0 * x * x * slope + 2.0 * {p1} * y + 6.0 * {p2} * x;
        float xy = 2.0 * x * y * slope + 2.0 * {p1} * x + 2.0 * {p2} * y;
        float yy = radial + 2.0 * y * y * slope + 6.0 * {p1} * y + 2.0 * {p2} * x;
        float determinant = xx * yy - xy * xy;
        x += (yy * off_x - xy * off_y) / determinant;
        y += (xx * off_y - xy * off_x) / determinant;
    }}
    float right = {r0} * x + {r1} * y + {r2};
    float down = {r3} * x + {r4} * y + {r5};
    float forward = {r6} * x + {r7} * y + {r8};
    direction = normalize(vector(right, -down, forward));
}}
"""


def set_real_eye(camera: Any, window: Window, eye: RealEye, folder: Path) -> None:
    """Make a Blender camera see the window of a real eye's image."""
    camera.type, camera.custom_mode = "CUSTOM", "INTERNAL"
    bytecode = _compiled(_source(window, eye), folder)
    digest = hashlib.md5(bytecode.encode(), usedforsecurity=False).hexdigest()
    if camera.custom_bytecode_hash != digest:
        camera.custom_bytecode, camera.custom_bytecode_hash = bytecode, digest


def _source(window: Window, eye: RealEye) -> str:
    numbers = {
        "left": window.left_px,
        "top": window.top_px,
        "width": window.width_px,
        "height": window.height_px,
        **dict(zip(("fx", "fy"), eye.focal_px, strict=True)),
        **dict(zip(("cx", "cy"), window.center_px, strict=True)),
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), eye.distortion, strict=True)),
        **{f"r{index}": value for index, value in enumerate(eye.ideal_from_real)},
    }
    return _SHADER.format(**{name: f"({float(value)!r})" for name, value in numbers.items()})


@lru_cache(maxsize=64)
def _compiled(source: str, folder: Path) -> str:
    """Bytecode of a shader.

    Raises:
        RuntimeError: this Blender cannot compile it.
    """
    # Part of `bpy`, and there once that is loaded.
    cycles: Any = importlib.import_module("_cycles")
    text, result = folder / "real_eye.osl", folder / "real_eye.oso"
    text.write_text(source, encoding="ascii")
    if not cycles.osl_compile(str(text), str(result)):
        raise RuntimeError("this Blender was built without Open Shading Language, which real lenses need")
    return result.read_text(encoding="ascii")
