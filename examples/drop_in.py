"""GCE and top-k soft-argmin in a volumetric network that has nothing else of stereokit.

Run it with ``python examples/drop_in.py``.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit import GCE, TopKSoftArgmin


class SmallStereoNet(nn.Module):
    """A hand-written matcher at quarter resolution; the two lines marked new are what stereokit adds."""

    def __init__(self, levels: int = 16) -> None:
        super().__init__()
        self.levels = levels
        self.features = nn.Sequential(
            nn.Conv2d(3, 24, 5, stride=2, padding=2), nn.ReLU(), nn.Conv2d(24, 24, 5, stride=2, padding=2)
        )
        self.conv1 = nn.Conv3d(24, 8, 3, padding=1)
        self.gce = GCE(guide_channels=24, volume_channels=8)  # new
        self.conv2 = nn.Conv3d(8, 1, 3, padding=1)
        self.regression = TopKSoftArgmin(k=2)  # new, in place of a soft-argmin

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """(B, 3, H, W) images to (B, H, W) disparity."""
        left, right = self.features(left), self.features(right)
        shifted = [F.pad(right, (d, 0))[..., : right.shape[-1]] for d in range(self.levels)]
        volume = left.unsqueeze(2) * torch.stack(shifted, dim=2)
        volume = self.gce(F.relu(self.conv1(volume)), left)
        logits = self.conv2(volume).squeeze(1)
        disparity = 4 * self.regression(logits)
        return F.interpolate(disparity.unsqueeze(1), scale_factor=4, mode="bilinear").squeeze(1)


def train_step(network: nn.Module, optimizer: torch.optim.Optimizer, shift: int) -> float:
    """One step on noise that moved by `shift` pixels."""
    noise = F.avg_pool2d(torch.rand(2, 3, 66, 66 + shift), 3, stride=1)
    left, right = noise[..., : -shift or None], noise[..., shift:]
    loss = F.smooth_l1_loss(network(left, right), torch.full((2, 64, 64), float(shift)))
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss.item()


def main() -> None:
    torch.manual_seed(0)
    network = SmallStereoNet()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = [train_step(network, optimizer, shift=4 * (1 + step % 4)) for step in range(30)]
    first, last = sum(losses[:10]) / 10, sum(losses[-10:]) / 10
    print(f"mean loss of the first ten steps {first:.2f} px, of the last ten {last:.2f} px")


if __name__ == "__main__":
    main()
