"""Which errors cost one frame, and which speak of the recipe or the place."""

from __future__ import annotations

from datasets_manifest.storage.manifest import Drop
from droguekit.batch.frame_task import OtherBuildError
from render.engine import EngineUnavailableError

# Errors that other frames would meet too; so does whatever the first frames of a run all fail by.
FATAL_ERRORS = (OSError, EngineUnavailableError, OtherBuildError)
FIRST_FRAMES = 3


def error_reason(error: BaseException) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def make_drop(frame_index: int, error: BaseException) -> Drop:
    """The drop of a frame that an error keeps from being made."""
    return Drop(frame_index=frame_index, reason=error_reason(error))
