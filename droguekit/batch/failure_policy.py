"""Which errors drop a single frame, and which end the run because other frames would fail too."""

from __future__ import annotations

from datasets_manifest.storage.manifest import Drop
from droguekit.batch.frame_task import OtherBuildError
from render.engine import EngineUnavailableError

# Errors of machine or storage, which other frames would meet too.
FATAL_ERRORS = (OSError, EngineUnavailableError, OtherBuildError)
# If so many first frames of a run all fail, whatever the error, the recipe is at fault.
FIRST_FRAMES = 3


def error_reason(error: BaseException) -> str:
    """The message of an error on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def make_drop(frame_index: int, error: BaseException) -> Drop:
    """Record that a frame is dropped because of an error."""
    return Drop(frame_index=frame_index, reason=error_reason(error))
