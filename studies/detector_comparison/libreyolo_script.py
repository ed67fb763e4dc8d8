"""Trains and exports networks of libreyolo in an environment of their own.

Run as a file, with its task as JSON on standard input.

Tasks: `{"do": "train", "config", "data", "folder", "epochs", "fraction", "size_px", "batch", "threads", "device",
"seed"}` and `{"do": "export", "config", "weights", "file", "size_px"}`. Without weights an untrained network is
exported.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple


class Network(NamedTuple):
    """A network of libreyolo.

    Attributes:
        family: module of its class.
        model, config: names of its class and of that of its default settings.
        size: of the family.
        least_last_epochs: least number of last epochs without strong augmentation. libreyolo all but stops D-FINE's
            running average there, so that such an epoch is lost in a short training.
    """

    family: str
    model: str
    config: str
    size: str
    least_last_epochs: int


_NETWORKS = {
    "d-fine-n": Network("dfine", "LibreDFINE", "DFINEConfig", "n", 0),
    "rtmdet-tiny": Network("rtmdet", "LibreRTMDet", "RTMDetConfig", "t", 1),
}
_OPERATORS: list[Any] = []


def train(task: dict[str, Any]) -> None:
    """Train from scratch with the default settings of libreyolo."""
    network, epochs = _NETWORKS[task["config"]], task["epochs"]
    defaults = getattr(importlib.import_module("libreyolo.training.config"), network.config)()
    # The same fraction of fewer epochs.
    last_epochs = round(epochs * defaults.no_aug_epochs / defaults.epochs)
    width, height = task["size_px"]
    open_model(network, None, task["device"]).train(
        data=training_data(Path(task["data"]), Path(task["folder"]), task["fraction"]),
        project=task["folder"],
        name="train",
        exist_ok=True,
        epochs=epochs,
        imgsz=width if width == height else (height, width),
        batch=task["batch"],
        device=task["device"],
        seed=task["seed"],
        workers=min(2, task["threads"]),
        warmup_epochs=min(defaults.warmup_epochs, 0.1 * epochs),
        no_aug_epochs=max(network.least_last_epochs, last_epochs) if epochs > 1 else 0,
        patience=0,
        pretrained=False,
    )


def open_model(network: Network, weights: str | None, device: str) -> Any:
    """The network for one class, with the weights of a file or random ones."""
    module = importlib.import_module(f"libreyolo.models.{network.family}.model")
    return getattr(module, network.model)(weights, size=network.size, nb_classes=1, device=device)


def training_data(data: Path, folder: Path, fraction: float) -> str:
    """The file of the data, or of one with only the first images to train on, because libreyolo has no such option."""
    if fraction == 1:
        return str(data)
    pictures = sorted((data.parent / "images" / "train").iterdir())
    images = folder / "train.txt"
    images.write_text("".join(f"{file}\n" for file in pictures[: round(fraction * len(pictures))]), encoding="utf-8")
    part = folder / "data.yaml"
    lines = f'path: "{data.parent}"\ntrain: "{images}"\nval: images/val\nnames:\n  0: drogue\n'
    part.write_text(lines, encoding="utf-8")
    return str(part)


def export(task: dict[str, Any]) -> None:
    """Export a network for two images to an ONNX file."""
    network, (width, height) = _NETWORKS[task["config"]], task["size_px"]
    model = open_model(network, task["weights"], "cpu")
    if network.family == "dfine":
        model.export(format="onnx", imgsz=height, batch=2, opset=17, dynamic=False, output_path=task["file"])
        return
    # libreyolo's own export of RTMDet takes squares only; its network has an output for export.
    torch = importlib.import_module("torch")
    model.model.eval().head.export = True
    images = torch.zeros(2, 3, height, width)
    torch.onnx.export(model.model, (images,), task["file"], opset_version=17, input_names=["images"], dynamo=False)


def replace_torchvision_operators() -> None:
    """Where torchvision cannot be loaded, define the only one of its operators that libreyolo uses in detection.

    The usual builds of torchvision need CUDA libraries beside torch. All else that libreyolo uses of it is Python.
    """
    try:
        importlib.import_module("torchvision")
        return
    except (ImportError, OSError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
    operators = importlib.import_module("torch").library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    operators.impl("nms", non_maximum_suppression, "CPU")
    # Operators go when their library is released.
    _OPERATORS.append(operators)
    importlib.import_module("torchvision").extension._has_ops = lambda: True


def non_maximum_suppression(boxes: Any, scores: Any, max_iou: float) -> Any:
    """Indices of the boxes that overlap no better one by more than `max_iou`, the best first.

    Args:
        boxes: (n, 4) low and high corners.
        scores: (n,).
        max_iou: intersection over union.
    """
    torch = importlib.import_module("torch")
    order = torch.argsort(scores, descending=True, stable=True)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    kept = []
    while len(order):
        best, order = order[0], order[1:]
        kept.append(best)
        low = torch.maximum(boxes[best, :2], boxes[order, :2])
        high = torch.minimum(boxes[best, 2:], boxes[order, 2:])
        common = (high - low).clamp(min=0).prod(1)
        order = order[common <= max_iou * (areas[best] + areas[order] - common)]
    return torch.stack(kept) if kept else order


def main() -> None:
    """Run the task on standard input."""
    task = json.load(sys.stdin)
    replace_torchvision_operators()
    {"train": train, "export": export}[task["do"]](task)


if __name__ == "__main__":
    main()
