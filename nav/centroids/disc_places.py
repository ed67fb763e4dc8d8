"""Where what stands in the vector of a disc's parameters."""

from __future__ import annotations

# Centre x, y; elements xx, yy, xy of the inverse shape: an ellipse's own, which come first.
ELLIPSE_PARAMETERS = 5
WIDTH, BACKGROUND, LEVEL = ELLIPSE_PARAMETERS, ELLIPSE_PARAMETERS + 1, ELLIPSE_PARAMETERS + 2
# Slopes of light outside and inside, if there are any, then lights of other backgrounds.
REST = LEVEL + 1
