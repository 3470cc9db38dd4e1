"""Candidates by PatchMatch: random ones, of which neighbours take over the better."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Candidates, Features, Prediction
from stereokit.costs.shift import check_features, inner_products
from stereokit.errors import ConfigError, InputError
from stereokit.registry import CANDIDATES

__all__ = ["PatchMatch", "patch_match", "scattered"]


def scattered(particles: int, height: int, width: int, *, like: Tensor) -> Tensor:
    r"""Numbers that fill [0, 1) evenly over any patch, and are the same every time.

    .. math:: u_i(y, x) = (0.618\, i + 0.755\, x + 0.570\, y) \bmod 1

    with the powers of the golden ratio and of its counterpart in the plane for factors.

    Args:
        particles: N.
        height: h.
        width: w.
        like: a tensor of the type and on the device wanted.

    Returns:
        (1, N, h, w).

    Source: Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.

    >>> u = scattered(1, 20, 20, like=torch.zeros(()))
    >>> [round(4 * q.item()) for q in u.quantile(torch.tensor([0.25, 0.5, 0.75]))]
    [1, 2, 3]
    """
    i, y, x = (torch.arange(n, device=like.device, dtype=torch.float32) for n in (particles, height, width))
    sums = 0.6180340 * i.reshape(-1, 1, 1) + 0.5698403 * y.reshape(-1, 1) + 0.7548777 * x
    return (sums - sums.floor()).to(like.dtype).unsqueeze(0)


def patch_match(
    left: Tensor, right: Tensor, noise: Tensor, planes: int, *, iterations: int = 2, sharpness: float = 7.0
) -> Tensor:
    r"""Disparities that match, one in each of N equal parts of the range, found without a look at all of them.

    Particle i of a pixel has a place :math:`u_i \in [0, 1)` in its part, :math:`d_i = (i + u_i)\, D / N`. In each
    iteration it becomes a mean of its own place and those of the neighbours to the left and to the right, then of those
    above and below, each weighed by how well it matches here:

    .. math:: u_i \leftarrow \sum_k w_k u_i^k, \quad w = \mathrm{softmax}_k\Big(\frac{s}{C} \sum_c l_c(y, x)\,
        r_c(y, x - \lfloor d_i^k \rfloor)\Big)

    Outside the map the place of a neighbour is 0, and the right map is that at its border.

    Args:
        left: l, (B, C, h, w).
        right: r, likewise.
        noise: the first places, (B or 1, N, h, w) in [0, 1).
        planes: D, in pixels of the maps.
        iterations: each along rows, then along columns.
        sharpness: s.

    Returns:
        (B, N, h, w), pixels of the maps, in ascending order.

    Raises:
        InputError: maps that are no pair, noise of another size, or fewer planes than particles.

    Source: Duggal et al., "DeepPruner: learning efficient stereo matching via differentiable PatchMatch", ICCV 2019,
    section 3.1.

    >>> features = 3 * torch.randn(1, 16, 8, 40, generator=torch.Generator().manual_seed(0))
    >>> found = patch_match(features, features.roll(-5, -1), scattered(4, 8, 40, like=features), 16)
    >>> found.shape
    torch.Size([1, 4, 8, 40])
    """
    check_features(left, right, planes)
    particles = noise.shape[1]
    if noise.shape[-2:] != left.shape[-2:] or noise.shape[0] not in (1, left.shape[0]):
        raise InputError(
            f"noise is (B or 1, N, h, w), of the size of the maps; got {tuple(noise.shape)} for maps "
            f"{tuple(left.shape)}"
        )
    if not 1 <= particles <= planes:
        raise InputError(
            f"{particles} particles have no part of {planes} planes each; use at least 1 and at most those"
        )
    # all scores there may be, once: cheaper than to gather features for each candidate
    scores = sharpness * _scores(left, right, planes)
    part = planes / particles
    first = torch.arange(particles, device=left.device).reshape(-1, 1, 1)

    def disparities(places: Tensor) -> Tensor:
        return (first + places) * part

    def step(places: Tensor, dim: int) -> Tensor:
        pad = (1, 1, 0, 0) if dim == 3 else (0, 0, 1, 1)
        padded, size = F.pad(places, pad), places.shape[dim]
        offers = torch.stack([padded.narrow(dim, shift, size) for shift in range(3)])
        index = disparities(offers).detach().long().clamp(max=planes - 1)
        matched = torch.stack([scores.gather(1, one) for one in index])
        return (matched.softmax(dim=0) * offers).sum(0)

    places = noise.expand(left.shape[0], -1, -1, -1).to(scores.dtype)
    for _ in range(iterations):
        places = step(step(places, 3), 2)
    return disparities(places)


def _scores(left: Tensor, right: Tensor, planes: int) -> Tensor:
    """Mean products of left and shifted right features, (B, D, h, w), the right ones repeated at their border."""
    more = planes - 1
    ahead, behind = F.pad(left / left.shape[1], (more, 0)), F.pad(right, (more, 0, 0, 0), mode="replicate")
    return inner_products(ahead, behind, planes)[..., more:].float()


@CANDIDATES.register("patch_match")
class PatchMatch(nn.Module):
    """`patch_match`, with the integers around what it found at both ends.

    In training mode the first places are random numbers, drawn anew for each pixel. In eval mode they are `scattered`,
    so that a pair has one result, exported networks too.

    Args:
        stride: of the maps that are compared.
        max_disparity: D, in px.
        particles: N.
        iterations: each along rows, then along columns.
        sharpness: of the weights by which neighbours are believed.

    Shape: features of stride `stride` to candidates (B, N + 2, h, w), whole pixels of the maps, given in px.

    Raises:
        ConfigError: fewer than one disparity for each particle.

    Source: Duggal et al., "DeepPruner", ICCV 2019, section 3.1.

    >>> maps = Features({4: torch.rand(1, 8, 4, 12)}, {})
    >>> PatchMatch(stride=4, max_disparity=64)(maps, maps, None).values.shape
    torch.Size([1, 14, 4, 12])
    """

    fixed = False

    def __init__(
        self, *, stride: int, max_disparity: int, particles: int = 12, iterations: int = 2, sharpness: float = 7.0
    ) -> None:
        super().__init__()
        self.levels = max_disparity // stride
        if not 1 <= particles <= self.levels or iterations < 1 or not sharpness > 0:
            raise ConfigError(
                f"particles={particles}, iterations={iterations} and sharpness={sharpness} of patch_match: expected "
                f"1 to {self.levels} particles, as many as there are disparities below {max_disparity} px at stride "
                f"{stride}, at least 1 iteration, and a sharpness above 0"
            )
        self.stride = stride
        self.spacing = float(stride)
        self.particles = particles
        self.planes = particles + 2
        self.iterations = iterations
        self.sharpness = sharpness

    def forward(self, left: Features, right: Features, before: Prediction | None) -> Candidates:
        """Features of both views to candidates; what a stage before predicted does not matter."""
        # whole candidates pass no gradient on
        maps = left.matching[self.stride].detach(), right.matching[self.stride].detach()
        batch, _, height, width = maps[0].shape
        if self.training:
            noise = torch.rand(batch, self.particles, height, width, device=maps[0].device)
        else:
            noise = scattered(self.particles, height, width, like=maps[0].new_zeros((), dtype=torch.float32))
        found = patch_match(*maps, noise, self.levels, iterations=self.iterations, sharpness=self.sharpness)
        return Candidates(self.stride * whole_with_ends(found, self.levels))

    def extra_repr(self) -> str:
        """Particles and iterations, for printing."""
        return f"particles={self.particles}, iterations={self.iterations}"


def whole_with_ends(found: Tensor, levels: int) -> Tensor:
    """Disparities (B, N, h, w) in ascending order to whole ones, (B, N + 2, h, w), the next above the last included."""
    whole = found.floor()
    return torch.cat((whole[:, :1], whole, found[:, -1:].ceil().clamp(max=float(levels))), dim=1)
