"""Train a toy network on pairs that are rendered meanwhile: it learns where the drogue is in the left image.

The network is far too small to be useful; the loop shows how samples arrive, and how a stopped training goes on.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.utils.data import DataLoader

import droguekit
from droguekit.torch import RenderStream, Sample

WIDTH_PX, HEIGHT_PX = 160, 120


def left_image_and_box(sample: Sample) -> tuple[torch.Tensor, torch.Tensor]:
    """The left image between 0 and 1, and the box's centre and size as shares of the image."""
    x, y, width, height = sample["boxes_px"][0]
    box = torch.stack([(x + width / 2) / WIDTH_PX, (y + height / 2) / HEIGHT_PX, width / WIDTH_PX, height / HEIGHT_PX])
    return sample["left"].float() / 255, box


def main() -> None:
    """Two epochs; the first renders, the second reads what the first has left."""
    recipe = droguekit.load_recipe(
        "smoke",
        rig={"preset": "rgb-ideal", "width_px": WIDTH_PX, "height_px": HEIGHT_PX, "focal_px": 266.0},
        distance={"law": "uniform", "low_m": 2.0, "high_m": 4.0},
        frames={"count": 12, "scenes": 4, "empty_fraction": 0.0},
        render={"engine": "analytic"},
    )
    stream = RenderStream(recipe, "stream-cache", replays=3, transform=left_image_and_box)
    # A new process renders, so that the training's own threads are not disturbed.
    loader = DataLoader(stream, batch_size=8, num_workers=1, multiprocessing_context="spawn")
    torch.manual_seed(0)
    network = nn.Sequential(
        *(nn.Conv2d(3, 8, 5, stride=4), nn.ReLU(), nn.Conv2d(8, 16, 5, stride=4), nn.ReLU()),
        *(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(256, 4), nn.Sigmoid()),
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    for epoch in range(2):
        stream.start_at(epoch)
        losses = []
        for images, boxes in loader:
            loss = nn.functional.smooth_l1_loss(network(images), boxes)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        print(f"epoch {epoch}: {len(losses)} steps, mean loss {sum(losses) / len(losses):.4f}")


if __name__ == "__main__":
    main()
