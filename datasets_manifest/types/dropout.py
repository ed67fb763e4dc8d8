"""What keeps the cameras of a sequence from seeing the drogue for a while."""

from __future__ import annotations

from typing import Literal

Loss = Literal["occlusion", "out-of-view", "glare"]
