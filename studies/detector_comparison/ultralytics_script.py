"""Trains and exports networks of ultralytics in an environment of their own.

Run as a file, with its task as JSON on standard input.

Tasks: `{"do": "train", "config", "data", "folder", "epochs", "fraction", "size_px", "batch", "step_images", "threads",
"device", "seed"}` and `{"do": "export", "config", "weights", "file", "size_px"}`. Without weights an untrained network
is exported.
"""

from __future__ import annotations

import importlib
import json
import shutil
import sys
import types
from pathlib import Path
from typing import Any


def train(yolo: Any, task: dict[str, Any]) -> None:
    """Train from scratch with the default settings of ultralytics, or resume from the last checkpoint."""
    last = Path(task["folder"]) / "train" / "weights" / "last.pt"
    if last.exists():
        torch = importlib.import_module("torch")
        # A complete training has no epoch to resume from; it may have been stopped in its final evaluation.
        if torch.load(last, map_location="cpu", weights_only=False)["epoch"] >= 0:
            yolo(str(last)).train(resume=True)
        return
    epochs = task["epochs"]
    yolo(task["config"]).train(
        data=task["data"],
        project=task["folder"],
        name="train",
        exist_ok=True,
        epochs=epochs,
        fraction=task["fraction"],
        imgsz=max(task["size_px"]),
        batch=task["batch"],
        nbs=task["step_images"],
        device=task["device"],
        seed=task["seed"],
        workers=min(2, task["threads"]),
        # The default is ten of a hundred epochs: the same fraction of fewer.
        close_mosaic=max(1, epochs // 10) if epochs > 1 else 0,
        warmup_epochs=min(3.0, 0.1 * epochs),
        patience=0,
        cache="ram",
        pretrained=False,
        # The check of mixed precision would download a network.
        amp=False,
        plots=False,
    )


def export(yolo: Any, task: dict[str, Any]) -> None:
    """Export a network for two images to an ONNX file."""
    width, height = task["size_px"]
    config, weights = task["config"], task["weights"]
    network = yolo(weights or config)
    if weights is None:
        tasks = importlib.import_module("ultralytics.nn.tasks")
        # One class, as after a training on our corpus.
        plain = tasks.DetectionModel(tasks.yaml_model_load(config), ch=3, nc=1, verbose=False)
        plain.args, plain.task = network.model.args, network.model.task
        network.model = plain
    made = network.export(format="onnx", imgsz=(height, width), batch=2, opset=17, simplify=False, dynamic=False)
    shutil.move(made, task["file"])


def replace_torchvision() -> None:
    """Where torchvision cannot be loaded, replace the function of it that ultralytics uses in detection.

    The usual builds of torchvision need CUDA libraries beside torch. ultralytics uses torchvision's non-maximum
    suppression if the module is loaded, and has an equivalent function of its own.
    """
    try:
        importlib.import_module("torchvision")
    except (ImportError, OSError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        own = importlib.import_module("ultralytics.utils.nms").TorchNMS
        stand_in: Any = types.ModuleType("torchvision")
        stand_in.ops = types.SimpleNamespace(nms=own.nms)
        sys.modules["torchvision"] = stand_in


def main() -> None:
    """Run the task on standard input."""
    task = json.load(sys.stdin)
    ultralytics = importlib.import_module("ultralytics")
    replace_torchvision()
    ultralytics.settings.update({"sync": False})
    {"train": train, "export": export}[task["do"]](ultralytics.YOLO, task)


if __name__ == "__main__":
    main()
