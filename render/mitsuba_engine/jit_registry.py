"""Room for numbers in Dr.Jit's registry of shapes, paints and lamps."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

# Eight kept scenes hold up to 40 shapes each, and the features of their drogues once more.
_NUMBERS = 1024


def reserve_numbers() -> Any:
    """Raise the highest number that was ever given to a shape, a paint or a lamp, before the first scene.

    Calls into scenes compile how many numbers there are into their kernels, as the distance between tables. Free
    numbers are given again, and the count falls only when the highest one is free. So kernels stay as they are while
    scenes with other drogues and bystanders of the same kinds of paint come and go; else each new scene would compile
    all of them anew.

    Returns:
        The shape with the highest number, to be kept for as long as there are scenes.
    """
    lamp = {
        "type": "rectangle",
        "bsdf": {"type": "diffuse"},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    # All of them have to be there at once.
    return [mi.load_dict(lamp) for _ in range(_NUMBERS)][-1]
