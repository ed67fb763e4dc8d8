"""Trains and exports YOLOv8, in the peers' own environment; run as a file, with its order as JSON on standard input.

Orders: `{"do": "train", "config", "data", "folder", "epochs", "fraction", "side_px", "batch", "threads", "device",
"seed"}` and `{"do": "export", "weights", "file", "size_px"}`. `weights` may be a configuration: an untrained network.
"""

from __future__ import annotations

import importlib
import json
import shutil
import sys
import types
from pathlib import Path
from typing import Any


def train(yolo: Any, order: dict[str, Any]) -> None:
    """Train from scratch with ultralytics' own settings; goes on from its last checkpoint if there is one."""
    last = Path(order["folder"]) / "train" / "weights" / "last.pt"
    if last.exists():
        torch = importlib.import_module("torch")
        # A training that is over leaves no epoch to go on from; it may have been stopped while it looked back.
        if torch.load(last, map_location="cpu", weights_only=False)["epoch"] >= 0:
            yolo(str(last)).train(resume=True)
        return
    epochs = order["epochs"]
    yolo(order["config"]).train(
        data=order["data"],
        project=order["folder"],
        name="train",
        exist_ok=True,
        epochs=epochs,
        fraction=order["fraction"],
        imgsz=order["side_px"],
        batch=order["batch"],
        device=order["device"],
        seed=order["seed"],
        workers=min(2, order["threads"]),
        # Ten of a hundred epochs by default: the same share of fewer.
        close_mosaic=max(1, epochs // 10) if epochs > 1 else 0,
        warmup_epochs=min(3.0, 0.1 * epochs),
        patience=0,
        cache="ram",
        pretrained=False,
        # Its check of half precision wants to download a network.
        amp=False,
        plots=False,
    )


def export(yolo: Any, order: dict[str, Any]) -> None:
    """Write a network for a pair as ONNX, under a name of ours."""
    width, height = order["size_px"]
    weights = order["weights"]
    network = yolo(weights)
    if weights.endswith(".yaml"):
        tasks = importlib.import_module("ultralytics.nn.tasks")
        # One class, as after a training on our corpus.
        plain = tasks.DetectionModel(tasks.yaml_model_load(weights), ch=3, nc=1, verbose=False)
        plain.args, plain.task = network.model.args, network.model.task
        network.model = plain
    made = network.export(format="onnx", imgsz=(height, width), batch=2, opset=17, simplify=False, dynamic=False)
    shutil.move(made, order["file"])


def replace_torchvision() -> None:
    """Where torchvision does not load, put a stand-in that has what ultralytics takes of it to detect.

    Its usual builds want CUDA's libraries beside torch. ultralytics drops overlapping boxes by torchvision's function
    where that is loaded, and has one of its own that gives the same.
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
    """Do what standard input says."""
    order = json.load(sys.stdin)
    ultralytics = importlib.import_module("ultralytics")
    replace_torchvision()
    ultralytics.settings.update({"sync": False})
    {"train": train, "export": export}[order["do"]](ultralytics.YOLO, order)


if __name__ == "__main__":
    main()
