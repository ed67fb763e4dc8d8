"""Where what stands in the vector of a disc's parameters."""

from __future__ import annotations

# Centre x, y; elements xx, yy, xy of the inverse shape: an ellipse's own, which come first.
ELLIPSE_PARAMETER_COUNT = 5
DISC_WIDTH, DISC_BACKGROUND, DISC_LEVEL = (
    ELLIPSE_PARAMETER_COUNT,
    ELLIPSE_PARAMETER_COUNT + 1,
    ELLIPSE_PARAMETER_COUNT + 2,
)
# Slopes of light outside and inside, if there are any, then lights of other backgrounds.
DISC_FIXED_COUNT = DISC_LEVEL + 1
