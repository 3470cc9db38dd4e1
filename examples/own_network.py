"""A network without slots: written, registered, saved and loaded, trained, exported and described.

Run it with ``python examples/own_network.py``.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit import StereoNetwork, StereoOutput, build_model, stereo_loss
from stereokit.bench.summary import model_summary
from stereokit.contracts import Prediction
from stereokit.costs import signed_correlation
from stereokit.data.synthetic import SyntheticScenes
from stereokit.export import export_program
from stereokit.layers import ConvNormAct
from stereokit.registry import MODELS


@MODELS.register("tiny")
class Tiny(StereoNetwork):
    """Correlation at stride 8, two convolutions, and the disparity: all that a network has to write is `match`.

    Its arguments are plain JSON values, so that its configuration rebuilds it.
    """

    def __init__(self, *, max_disparity: int = 64, channels: int = 24) -> None:
        super().__init__(max_disparity=max_disparity, multiple=8)
        self.reach = max_disparity // 8
        self.features = nn.Sequential(
            ConvNormAct(3, channels, 5, stride=2),
            ConvNormAct(channels, channels, 5, stride=2),
            ConvNormAct(channels, channels, 5, stride=2, activation=None),
        )
        self.head = nn.Sequential(
            ConvNormAct(2 * self.reach + 1 + channels, 32), ConvNormAct(32, 32), nn.Conv2d(32, 1, 3, padding=1)
        )

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Normalised and padded images to the output."""
        of_left, of_right = self.features(torch.cat((left, right))).chunk(2)
        seen = signed_correlation(of_left, of_right, self.reach)
        coarse = self.max_disparity * self.head(torch.cat((seen, of_left), dim=1)).sigmoid()
        disparity = F.interpolate(coarse, scale_factor=8.0, mode="bilinear").squeeze(1)
        return StereoOutput(disparity, (Prediction(disparity),))


def batch_of(scenes: SyntheticScenes, numbers: range) -> tuple[Tensor, Tensor, Tensor]:
    """Images (B, 3, H, W) and disparities (B, H, W) of rendered scenes."""
    pairs = [scenes[number] for number in numbers]
    left, right = (
        torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        for images in ([pair.left for pair in pairs], [pair.right for pair in pairs])
    )
    return left, right, torch.from_numpy(np.stack([pair.disparity for pair in pairs]))


def train(network: StereoNetwork, steps: int) -> list[float]:
    """The loss of each step on rendered scenes; `stereokit train` does it by a recipe with ``name = "tiny"``."""
    scenes = SyntheticScenes(size=(64, 128), max_disparity=24, photometric=0)
    optimizer = torch.optim.Adam(network.train().parameters(), lr=3e-3)
    losses = []
    for step in range(steps):
        left, right, truth = batch_of(scenes, range(4 * step, 4 * step + 4))
        loss = stereo_loss(network(left, right), truth, auxiliary_weights=network.auxiliary_weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


def main() -> None:
    torch.manual_seed(0)
    network = build_model("tiny", max_disparity=32)
    losses = train(network, steps=24)
    network.eval()
    images = torch.rand(2, 1, 3, 120, 200)
    with TemporaryDirectory() as folder, torch.inference_mode():
        network.save_pretrained(folder)
        again = StereoNetwork.from_pretrained(folder)
        same = torch.equal(again(*images).disparity, network(*images).disparity)
        report = export_program(network, Path(folder) / "tiny.pt2", size=(120, 200))
    for block in model_summary(network, 120, 200):
        print(f"{block.slot:9} {block.parameters:7,} parameters  {block.multiply_adds / 1e6:7.1f} M multiply-adds")
    print(report)
    print(f"loss of the first eight steps {np.mean(losses[:8]):.2f}, of the last eight {np.mean(losses[-8:]):.2f}")
    print(f"{network.config} is {'the same' if same else 'another'} network when it is loaded")


if __name__ == "__main__":
    main()
