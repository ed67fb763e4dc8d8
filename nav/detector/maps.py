"""What a detector network answers: one map a stride, and what the numbers of its cells mean.

A cell (row i, column j) of stride s has its centre at `((j + 0.5) s, (i + 0.5) s)` in the input image, counted from
the corner of the image. Its five channels are the logit of the score and the logarithms of the distances from that
centre to the left, top, right and bottom side of the box, in strides.
"""

from __future__ import annotations

STRIDES = (8, 16, 32)
"""Pixels of the input image between cells, by map. [px]"""

MAP_CHANNELS = 5
"""Logit of the score, then left, top, right, bottom."""

SIZE_STEP_PX = STRIDES[-1]
"""Width and height of an input image are multiples of it. [px]"""

MOST_SIDE_PX = 4096
"""Width and height of an input image are at most this: a wrong number is refused before it asks for memory. [px]"""

LOG_DISTANCE_RANGE = (-6.0, 6.0)
"""Beyond it a logarithm of a distance is cut: from a 400th of a stride to 400 strides."""
