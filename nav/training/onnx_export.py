"""A trained network to an ONNX file that `nav.detector.onnx_detector` runs."""

from __future__ import annotations

import copy
import io
import warnings
from pathlib import Path

import onnx
import torch

from datasets_manifest.atomic import open_bytes_atomic
from nav.detector.maps import SIZE_STEP_PX, STRIDES
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import DetectorNetwork

INPUT_NAME = "images"
OUTPUT_NAMES = tuple(f"maps_{stride}" for stride in STRIDES)
# The first with every operator of the network (HardSwish came with 14); older run times know it too.
_OPSET = 17
_DYNAMIC = {0: "batch", 2: "height", 3: "width"}


def export_onnx(network: DetectorNetwork, path: Path, metadata: ModelMetadata) -> None:
    """Write a network in float32, for any number and size of images, by one rename.

    Args:
        network: left as it is.
        path: of the file.
        metadata: written into the file.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    model = onnx.load_from_string(_traced(network))
    model.producer_name, model.producer_version = "droguekit", ""
    onnx.helper.set_model_props(model, {METADATA_KEY: metadata.to_json()})
    onnx.checker.check_model(model)
    with open_bytes_atomic(path) as stream:
        stream.write(model.SerializeToString())


def _traced(network: DetectorNetwork) -> bytes:
    """The network as ONNX, the images' gain and batch normalisation folded into the convolutions."""
    still = copy.deepcopy(network).to("cpu", torch.float32).eval()
    still.fold_gain()
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter by tracing is to go in a later torch than the one that is pinned; the new one takes eight times
        # as long for the same graph.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            still,
            (torch.zeros(len(STRIDES), 3, SIZE_STEP_PX, 2 * SIZE_STEP_PX),),
            buffer,  # type: ignore[arg-type]  # the exporter by tracing takes a stream, its annotation does not say so
            input_names=[INPUT_NAME],
            output_names=list(OUTPUT_NAMES),
            dynamic_axes=dict.fromkeys((INPUT_NAME, *OUTPUT_NAMES), _DYNAMIC),
            opset_version=_OPSET,
            dynamo=False,
        )
    return buffer.getvalue()
