"""The paint of an aircraft by scheme: its colours, and where each of them lies."""

from __future__ import annotations

from dataclasses import dataclass

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.tankers.tanker import PaintScheme


@dataclass(frozen=True)
class Scheme:
    """Colours of a scheme, diffuse, linear Rec. 709.

    Attributes:
        above, below: the body's upper and lower colour.
        wing: of wings and tail planes; None for the body's.
        blotches: second colour of a two-tone camouflage, or None.
        wraps: whether the camouflage goes round the lower side too.
        cheat_line: of the line along the windows, or None.
        accent: of wing tips, fins and bands, or None.
        bare_edges: whether leading edges are bare metal.
        marked: whether it has roundels.
        toned_down: whether they are grey.
        windows: whether the cabin has windows.
        weave: whether it shows the weave of carbon fibre.
    """

    above: ReflectanceRgb
    below: ReflectanceRgb
    wing: ReflectanceRgb | None = None
    blotches: ReflectanceRgb | None = None
    wraps: bool = True
    cheat_line: ReflectanceRgb | None = None
    accent: ReflectanceRgb | None = None
    bare_edges: bool = False
    marked: bool = True
    toned_down: bool = True
    windows: bool = False
    weave: bool = False


# Greys are close to the FS 595 numbers named beside them; all other colours are our choice.
SCHEMES: dict[PaintScheme, Scheme] = {
    "light-grey": Scheme(above=(0.37, 0.385, 0.395), below=(0.37, 0.385, 0.395)),  # FS 36375
    "medium-grey": Scheme(above=(0.235, 0.255, 0.27), below=(0.26, 0.28, 0.295), bare_edges=True),  # FS 36173
    "white-cheat-line": Scheme(
        above=(0.74, 0.74, 0.73),
        below=(0.43, 0.44, 0.45),
        wing=(0.45, 0.46, 0.47),
        cheat_line=(0.02, 0.05, 0.20),
        bare_edges=True,
        toned_down=False,
        windows=True,
    ),
    "dark-grey": Scheme(above=(0.095, 0.10, 0.105), below=(0.125, 0.13, 0.135)),  # FS 36118
    "desert": Scheme(above=(0.40, 0.29, 0.17), below=(0.40, 0.30, 0.19), blotches=(0.19, 0.115, 0.065), wraps=True),
    "olive": Scheme(
        above=(0.085, 0.095, 0.05),
        below=(0.33, 0.35, 0.36),
        blotches=(0.055, 0.06, 0.065),
        wraps=False,
        toned_down=False,
    ),
    "navy": Scheme(above=(0.225, 0.25, 0.275), below=(0.40, 0.42, 0.43)),  # FS 36320 over FS 36375, faded
    "trainer": Scheme(above=(0.70, 0.70, 0.69), below=(0.68, 0.68, 0.67), accent=(0.60, 0.14, 0.02), toned_down=False),
    "carbon": Scheme(above=(0.032, 0.032, 0.034), below=(0.030, 0.030, 0.032), weave=True, marked=False),
}
