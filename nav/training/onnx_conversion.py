"""A trained network to an ONNX file that `nav.detector.onnx_detector` runs, and back to weights that can be trained.

In an exported file batch normalisation is folded into the convolutions. On import each convolution first gets a batch
normalisation that reproduces the file's outputs, and then one whose statistics fit the batches of a training.
"""

from __future__ import annotations

import copy
import io
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from onnx.external_data_helper import uses_external_data
from torch import Tensor, nn

from datasets_manifest.atomic import open_bytes_atomic
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.detector.output_maps import SIZE_STEP_PX, STRIDES

INPUT_NAME = "images"
OUTPUT_NAMES = tuple(f"maps_{stride}" for stride in STRIDES)
# Has every operator of the network (HardSwish came with 14), and older runtimes support it.
_OPSET = 17
_DYNAMIC = {0: "batch", 2: "height", 3: "width"}


def trace_onnx(network: DetectorNetwork) -> onnx.ModelProto:
    """The network as ONNX, in float32, for any number and size of images.

    The images' gain and batch normalisation are folded into the convolutions; the network is not changed. Tracing takes
    seconds: one trace serves several files that differ in their metadata alone.
    """
    still = copy.deepcopy(network).to("cpu", torch.float32).eval()
    still.fold_gain()
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A later torch will drop the exporter by tracing; its successor takes eight times as long for the same graph.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            still,
            (torch.zeros(len(STRIDES), 3, SIZE_STEP_PX, 2 * SIZE_STEP_PX),),
            buffer,  # type: ignore[arg-type]  # it takes a stream too, against its annotation
            input_names=[INPUT_NAME],
            output_names=list(OUTPUT_NAMES),
            dynamic_axes=dict.fromkeys((INPUT_NAME, *OUTPUT_NAMES), _DYNAMIC),
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    model.producer_name, model.producer_version = "droguekit", ""
    onnx.checker.check_model(model)
    return model


def write_onnx(model: onnx.ModelProto, path: Path, metadata: ModelMetadata) -> None:
    """Write a traced network with its metadata, which replace the model's; the file appears by one rename.

    Raises:
        OSError: the file cannot be written; the message names it. No partial file is left.
    """
    onnx.helper.set_model_props(model, {METADATA_KEY: metadata.to_json()})
    with open_bytes_atomic(path) as stream:
        stream.write(model.SerializeToString())


Convolution = nn.Conv1d | nn.Conv2d

# He's initialization with fan-in n gives filters of norm sqrt(n * 2/n). A step of AdamW changes a weight by about the
# learning rate, so trained filters of this norm change several times more slowly than the small ones of a new network.
_FILTER_NORM = 2**0.5


def import_onnx(content: bytes) -> DetectorNetwork:
    """Read the network in a file, in evaluation mode, with the same outputs as the file.

    Its batch normalisation only adds an offset, so it must not be trained before `recalibrate_batch_norm`.

    Raises:
        ValueError: not a complete ONNX file, or not one that droguekit exported; the message says what is wrong.
    """
    try:
        model = onnx.load_from_string(content)
    except Exception as error:  # protobuf's exceptions differ by its implementation
        raise ValueError("is truncated or not an ONNX file") from error
    text = {entry.key: entry.value for entry in model.metadata_props}.get(METADATA_KEY, "{}")
    stated = ModelMetadata.from_json(text).network
    if not stated:
        raise ValueError("does not say which of droguekit's networks it is")
    network = DetectorNetwork(NetworkConfig.from_dict(stated)).eval()
    # droguekit writes the weights into the file; a file must not make this program read others.
    if any(uses_external_data(each) for each in model.graph.initializer):
        raise ValueError("keeps its weights in other files")
    arrays = {each.name: each for each in model.graph.initializer}
    for node in model.graph.node:
        # The exporter writes equal values only once.
        if node.op_type == "Identity" and node.input[0] in arrays:
            arrays[node.output[0]] = arrays[node.input[0]]
    nodes = [node for node in model.graph.node if node.op_type == "Conv"]
    layers = list(_normalised_convolutions(network))
    try:
        # The file lists them in the order in which they run; another number of them is another network.
        for node, (convolution, norm) in zip(nodes, layers, strict=True):
            values = [torch.tensor(numpy_helper.to_array(arrays[name])) for name in node.input[1:]]
            _load_convolution(convolution, norm, *values)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError("does not have the layers of the network that its metadata states") from error
    with torch.no_grad():
        network.backbone.stem_weights.div_(network.gain)
    return network


def recalibrate_batch_norm(network: DetectorNetwork, batches: Iterable[Tensor]) -> None:
    """Give batch normalisation the statistics of the convolutions' outputs, without a change of the network's outputs.

    Means and variances become those over the images; scales and offsets compensate for them. Filters are scaled to one
    norm.

    Args:
        network: from `import_onnx`; its mode is not changed.
        batches: (B, 3, H, W) each, as for `DetectorNetwork.forward`.
    """
    layers = [(convolution, norm) for convolution, norm in _normalised_convolutions(network) if norm is not None]
    sums = {norm: torch.zeros(2, norm.num_features, dtype=torch.float64) for _, norm in layers}

    def add(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        values = inputs[0].detach().double().cpu()
        assert isinstance(norm, nn.BatchNorm2d)
        sums[norm] += torch.stack((values.mean((0, 2, 3)), values.square().mean((0, 2, 3))))

    hooks = [norm.register_forward_pre_hook(add) for _, norm in layers]
    was_training, count = network.training, 0
    network.eval()
    try:
        with torch.inference_mode():
            for images in batches:
                network(images)
                count += 1
    finally:
        network.train(was_training)
        for hook in hooks:
            hook.remove()
    for convolution, norm in layers:
        mean, square = sums[norm] / max(count, 1)
        _set_statistics(convolution, norm, mean, (square - mean.square()).clamp(min=0))


@torch.no_grad()
def _set_statistics(convolution: Convolution, norm: nn.BatchNorm2d, mean: Tensor, variance: Tensor) -> None:
    """Set mean and variance of the convolution's output; before, the mean is 0 and the scale cancels the variance."""
    assert norm.running_mean is not None and norm.running_var is not None
    lengths = convolution.weight.flatten(1).norm(dim=1).double().cpu() / _FILTER_NORM
    # A zero filter stays zero.
    lengths[lengths == 0] = 1
    offset = norm.bias.double().cpu() + mean
    convolution.weight.div_(lengths.to(convolution.weight).reshape(-1, *[1] * (convolution.weight.ndim - 1)))
    norm.running_mean.copy_(mean / lengths)
    norm.running_var.copy_(variance / lengths**2)
    norm.weight.copy_(lengths * (variance / lengths**2 + norm.eps).sqrt())
    norm.bias.copy_(offset)


@torch.no_grad()
def _load_convolution(
    convolution: Convolution, norm: nn.BatchNorm2d | None, weight: Tensor, bias: Tensor | None = None
) -> None:
    """Copy a file's convolution; its bias goes into the batch normalisation, if there is one."""
    _copy(convolution.weight, weight)
    if norm is None:
        own = convolution.bias
        if (own is None) != (bias is None):
            raise ValueError("one of the two has a bias")
        if own is not None and bias is not None:
            _copy(own, bias)
        return
    assert norm.running_mean is not None and norm.running_var is not None
    if bias is None:
        raise ValueError("batch normalisation is not folded")
    _copy(norm.bias, bias)
    norm.running_mean.zero_()
    norm.running_var.fill_(1)
    norm.weight.fill_((1 + norm.eps) ** 0.5)


def _copy(to: Tensor, values: Tensor) -> None:
    if to.shape != values.shape:
        raise ValueError(f"must be {tuple(to.shape)}, got {tuple(values.shape)}")
    to.copy_(values)


def _normalised_convolutions(network: DetectorNetwork) -> Iterator[tuple[Convolution, nn.BatchNorm2d | None]]:
    """All convolutions in the order in which they run, each with the batch normalisation right after it, if any."""
    run: list[nn.Module] = []
    kinds = (nn.Conv1d, nn.Conv2d, nn.BatchNorm2d)
    hooks = [
        module.register_forward_pre_hook(lambda module, _: run.append(module))
        for module in network.modules()
        if isinstance(module, kinds)
    ]
    was_training = network.training
    network.eval()
    try:
        with torch.inference_mode():
            network(torch.zeros(1, 3, SIZE_STEP_PX, SIZE_STEP_PX, device=network.backbone.stem_weights.device))
    finally:
        network.train(was_training)
        for hook in hooks:
            hook.remove()
    for module, following in zip(run, [*run[1:], None], strict=True):
        if isinstance(module, nn.Conv1d | nn.Conv2d):
            yield module, following if isinstance(following, nn.BatchNorm2d) else None
