import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit import ConfigError, InputError, StereoOutput, build_model
from stereokit.inference import bounds
from stereokit.inference.bounds import BoundedMatcher, MemoryPlan
from stereokit.inference.scaling import match_scaled
from stereokit.inference.tiles import _weights, match_tiles, tile_grid
from stereokit.optimize import prepare_for_inference
from tests.shared import SHARED, needs_shared


def local(left: Tensor, right: Tensor) -> StereoOutput:
    """Looks 8 pixels around, and 30 to the left in the right image."""
    far = F.pad(right.float(), (30, 0))[..., :-30]
    mean = F.avg_pool2d(F.pad(left.float() + far, [8] * 4), 17, stride=1).mean(1)
    return StereoOutput(mean, confidence=mean / 4)


sides = st.integers(32, 400)


@given(
    length=sides,
    size=sides,
    context=st.integers(0, 80),
    overlap=st.integers(0, 80),
    multiple=st.sampled_from([1, 8, 32]),
)
def test_windows_cover_a_side_and_weights_are_shares(
    length: int, size: int, context: int, overlap: int, multiple: int
) -> None:
    try:
        _, windows = tile_grid((32, length), (32, size), max_disparity=context, overlap=overlap, multiple=multiple)
    except InputError:
        assert size < min(length, max(32, context + overlap) + multiple)
        return
    weights = _weights(windows, length, context, overlap)
    torch.testing.assert_close(weights.sum(0), torch.ones(length))
    assert weights.min() >= 0
    assert windows[0][0] == 0
    assert windows[-1][1] == length
    for (start, stop), weight in zip(windows, weights, strict=True):
        assert start % multiple == 0
        assert 32 <= stop - start <= size
        used = weight.nonzero().flatten()
        # its whole range of disparities, and a quarter of the overlap, unless the image ends there
        assert start == 0 or used[0] >= start + context + overlap / 4 - 1
        assert stop == length or used[-1] <= stop - overlap / 4
    assert len(windows) == 1 or length > size


@given(height=st.integers(40, 130), width=st.integers(100, 260), tall=st.integers(70, 120), wide=st.integers(115, 220))
def test_what_looks_no_farther_than_the_overlap_is_matched_as_a_whole(
    height: int, width: int, tall: int, wide: int
) -> None:
    left, right = torch.rand(2, 2, 3, height, width)
    whole = local(left, right)
    tiled = match_tiles(local, left, right, tile=(tall, wide), max_disparity=30, overlap=32, multiple=8)
    torch.testing.assert_close(tiled.disparity, whole.disparity)
    torch.testing.assert_close(tiled.confidence, whole.confidence)


def test_disparities_need_the_columns_on_their_left() -> None:
    left, right = torch.rand(2, 1, 3, 40, 300)
    whole = local(left, right).disparity
    short = match_tiles(local, left, right, tile=(40, 120), max_disparity=0, overlap=32).disparity
    assert (short - whole).abs().max() > 0.1


def test_values_that_are_dropped_may_be_anything() -> None:
    def nan_at_the_edges(left: Tensor, right: Tensor) -> StereoOutput:
        disparity = torch.full(left[:, 0].shape, torch.nan)
        disparity[..., 3:-3] = 1
        return StereoOutput(disparity)

    left = torch.rand(1, 3, 40, 200)
    tiled = match_tiles(nan_at_the_edges, left, left, tile=(40, 100), max_disparity=0, overlap=16)
    assert (tiled.disparity[..., 3:-3] == 1).all()
    assert tiled.confidence is None


def test_tiles_that_their_overlaps_fill_are_refused() -> None:
    left = torch.rand(1, 3, 400, 700)
    with pytest.raises(InputError, match=r"width 320 are too small: 320 px are shared .* use 352 or more"):
        match_tiles(local, left, left, tile=(400, 320), max_disparity=192, multiple=32)
    with pytest.raises(InputError, match="tiles of height 100 are too small"):
        match_tiles(local, left, left, tile=(100, 700), max_disparity=192)
    with pytest.raises(InputError, match="overlap -1"):
        match_tiles(local, left, left, tile=(400, 600), max_disparity=0, overlap=-1)


@given(scale=st.floats(0.3, 2.5), height=st.integers(110, 150), width=st.integers(110, 300))
def test_the_disparity_of_another_resolution_is_scaled_with_the_width(scale: float, height: int, width: int) -> None:
    """A network that sees how wide a band is gives the same answer, in pixels of the whole pair."""

    def position(left: Tensor, right: Tensor) -> StereoOutput:
        columns = torch.arange(left.shape[-1]) + 0.5
        return StereoOutput(columns.expand(left[:, 0].shape), confidence=left[:, 0])

    left = torch.full((1, 3, height, width), 51, dtype=torch.uint8)
    output = match_scaled(position, left, left, scale=scale)
    expected = (torch.arange(width) + 0.5).expand(1, height, width)
    border = int(2 / scale) + 1
    inside = (..., slice(border, -border))
    torch.testing.assert_close(output.disparity[inside], expected[inside], atol=1e-2, rtol=1e-4)
    assert output.confidence is not None
    torch.testing.assert_close(output.confidence, torch.full_like(output.confidence, 0.2))


@pytest.mark.parametrize(
    ("scale", "message"),
    [(0, "above 0"), (-1, "above 0"), (8.1, "at most 8"), (math.nan, "above 0"), (0.1, r"use at least 0\.32")],
)
def test_a_scale_that_can_not_be_is_refused(scale: float, message: str) -> None:
    left = torch.rand(1, 3, 100, 200)
    with pytest.raises(InputError, match=message):
        match_scaled(local, left, left, scale=scale)


@pytest.mark.parametrize("scale", [2.2, 1.5, 1.1, 0.95, 0.75, 0.6, 0.43])
def test_pixels_are_where_they_were_at_another_resolution(scale: float) -> None:
    def brightness(left: Tensor, right: Tensor) -> StereoOutput:
        return StereoOutput(left[:, 0] * left.shape[-1])

    ramp = (torch.arange(400) + 0.5).expand(1, 3, 80, 400) / 400
    output = match_scaled(brightness, ramp, ramp, scale=scale)
    torch.testing.assert_close(output.disparity[..., 10:-10], 400 * ramp[:, 0, :, 10:-10], atol=0.15, rtol=0)


@pytest.mark.parametrize("scale", [1.5, 2, 3])
@pytest.mark.parametrize("edge", [120, 121])
def test_edges_stay_sharp_on_the_way_back_from_a_higher_resolution(scale: float, edge: int) -> None:
    def step(left: Tensor, right: Tensor) -> StereoOutput:
        near = torch.arange(left.shape[-1]) < edge
        return StereoOutput(torch.where(near, 20 * scale, 10 * scale).expand(left[:, 0].shape))

    images = torch.rand(1, 3, 40, 120)
    disparity = match_scaled(step, images, images, scale=scale).disparity[0, 20]
    assert ((disparity > 10.01) & (disparity < 19.99)).sum() <= 1
    assert abs(int((disparity > 15).sum()) - edge / scale) <= 1


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_scaled_pairs_keep_their_type(dtype: torch.dtype) -> None:
    def match(left: Tensor, right: Tensor) -> StereoOutput:
        assert left.dtype == right.dtype == dtype
        return StereoOutput(left[:, 0])

    images = torch.rand(1, 3, 80, 120).to(dtype)
    assert match_scaled(match, images, images, scale=0.6).disparity.shape == (1, 80, 120)


class Small(nn.Module):
    """A network that needs 1000 bytes a pixel, as it says itself."""

    max_disparity = 30
    multiple = 8

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[int, ...]] = []

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        self.seen.append(tuple(left.shape[-2:]))
        return local(left, right)


def bounded(max_memory: int | str, too_large: str = "error") -> tuple[BoundedMatcher, Small]:
    network = Small()
    matcher = BoundedMatcher(
        network,
        max_memory=max_memory,
        too_large=too_large,  # type: ignore[arg-type]
        overlap=32,
        estimate=lambda height, width: 1000 * height * width,
    )
    return matcher, network


PAIR = torch.rand(2, 1, 3, 160, 400)


def test_a_pair_that_fits_is_matched_whole() -> None:
    matcher, network = bounded("64MB")
    torch.testing.assert_close(matcher(*PAIR).disparity, local(*PAIR).disparity)
    assert network.seen == [(160, 400)]


def test_nothing_is_kept_for_gradients() -> None:
    network = nn.Conv2d(3, 1, 1)

    def run(left: Tensor, right: Tensor) -> StereoOutput:
        return StereoOutput(network(left)[:, 0])

    matcher = BoundedMatcher(network, run=run, max_memory="1GB", estimate=lambda height, width: height * width)
    assert not matcher(*PAIR).disparity.requires_grad
    assert not matcher.match(*PAIR, MemoryPlan("tile", 1, 1, tile=(160, 300))).disparity.requires_grad


def test_tiles_of_a_prepared_network_are_those_of_the_network() -> None:
    model = build_model("coex", max_disparity=64)
    prepared, plain = BoundedMatcher(prepare_for_inference(model)), BoundedMatcher(model)
    assert (prepared.max_disparity, prepared.multiple) == (plain.max_disparity, plain.multiple) == (64, 32)
    assert prepare_for_inference(model).config == model.config


def test_a_pair_that_does_not_fit_is_refused_before_it_starts() -> None:
    matcher, network = bounded("30MB")
    message = (
        r"400 x 160 pixels needs about 61 MiB of memory, 29 MiB are allowed by max_memory; "
        r"too_large='tile' \(--too-large tile\) would match it in \d+ overlapping tiles of \d+ x \d+ pixels, "
        r"with disparities up to 30 px, "
        r"too_large='reduce' \(--too-large reduce\) would match it at 0\.68 of its size, with disparities up to 44 px"
    )
    with pytest.raises(InputError, match=message):
        matcher(*PAIR)
    assert network.seen == []


@pytest.mark.parametrize("megabytes", [12, 20, 30, 45, 60])
def test_tiles_and_reduced_pairs_stay_within_the_memory(megabytes: int) -> None:
    matcher, network = bounded(megabytes * 10**6, "tile")
    torch.testing.assert_close(matcher(*PAIR).disparity, local(*PAIR).disparity)
    assert len(network.seen) == matcher.plan(160, 400).tiles > 1
    assert all(1000 * h * w <= megabytes * 10**6 for h, w in network.seen)

    matcher, network = bounded(megabytes * 10**6, "reduce")
    assert matcher(*PAIR).disparity.shape == (1, 160, 400)
    [(h, w)] = network.seen
    # as large as fits, to a few percent
    assert 0.9 * megabytes * 10**6 < 1000 * h * w <= megabytes * 10**6


def test_memory_that_does_not_grow_with_the_pixels_alone_is_respected() -> None:
    def estimate(height: int, width: int) -> int:
        return 10_000_000 + 1000 * height * width

    for tiles in ("tile", "reduce"):
        network = Small()
        settings = {"too_large": tiles, "overlap": 32, "estimate": estimate}
        matcher = BoundedMatcher(network, max_memory="30MB", **settings)  # type: ignore[arg-type]
        matcher(*PAIR)
        assert all(estimate(*size) <= 30_000_000 for size in network.seen)


def test_where_nothing_fits_the_message_says_so() -> None:
    # 32 x 80 pixels
    expected = r"neither a tile nor a reduced resolution fits: even at 0\.2 of its size it needs about 2 MiB"
    for tiles in ("error", "tile", "reduce"):
        matcher, _ = bounded(10_000, tiles)
        with pytest.raises(InputError, match=expected):
            matcher(*PAIR)
    matcher, _ = bounded("2.7MB", "tile")
    with pytest.raises(InputError, match=r"too_large='reduce' .* would match it at 0\.2 of"):
        matcher(*PAIR)


def test_the_memory_of_a_larger_pair_is_a_bound() -> None:
    asked: list[tuple[int, int]] = []

    def estimate(height: int, width: int) -> int:
        asked.append((height, width))
        return height * width

    matcher = BoundedMatcher(Small(), max_memory=10**6, estimate=estimate)
    for size in ((100, 200), (100, 200), (90, 200), (100, 201)):
        assert matcher.plan(*size).how == "whole"
    assert asked == [(100, 200), (100, 201)]


def test_tiles_are_not_offered_where_nobody_knows_what_they_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(Small, "max_disparity")
    with pytest.raises(InputError, match="needs about") as refused:
        bounded("40MB")[0](*PAIR)
    assert "tile" not in str(refused.value)
    assert "too_large='reduce'" in str(refused.value)


def test_running_out_of_memory_all_the_same_is_one_line() -> None:
    def full(left: Tensor, right: Tensor) -> StereoOutput:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(InputError, match="more memory"):
        BoundedMatcher(Small(), run=full, max_memory="1GB", estimate=lambda h, w: 1)(*PAIR)


def test_what_the_process_keeps_of_freed_tensors_is_handed_back_where_it_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    free = [10_000_000]
    monkeypatch.setattr(bounds, "available_memory", lambda device: free[0])
    monkeypatch.setattr(bounds, "hand_back_memory", lambda: free.append(free.pop() + 60_000_000))
    matcher = BoundedMatcher(Small(), estimate=lambda height, width: 1000 * height * width)
    assert matcher.plan(100, 90) == MemoryPlan("whole", 9_000_000, 10_000_000)
    assert matcher.plan(160, 400) == MemoryPlan("whole", 64_000_000, 70_000_000)


def test_what_is_asked_for_is_checked() -> None:
    with pytest.raises(ConfigError, match="'error', 'tile' or 'reduce'"):
        bounded("1GB", "tiles")
    nameless = nn.Conv2d(3, 1, 1)
    with pytest.raises(ConfigError, match="Conv2d has no attribute max_disparity"):
        BoundedMatcher(nameless, too_large="tile")
    with pytest.raises(ConfigError, match="no amount of memory"):
        bounded("lots")


def smooth_scene(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """A textured surface without edges: left and right image, and disparity."""
    rng = np.random.default_rng(0)
    texture = np.zeros((height, width, 3), np.float32)
    for step in (1, 2, 4, 8, 16):
        noise = rng.random((height // step + 2, width // step + 2, 3), dtype=np.float32)
        texture += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) * (0.5 if step < 3 else 1)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = 40 + 20 * np.sin(5 * x / width) + 10 * y / height
    left = cv2.remap(texture, x - disparity, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    images = (torch.from_numpy(view).clamp(0, 1).permute(2, 0, 1)[None] for view in (left, texture))
    return *images, torch.from_numpy(disparity)  # type: ignore[return-value]


@needs_shared
@pytest.mark.slow
def test_a_trained_network_leaves_no_seams_on_a_smooth_scene() -> None:
    from stereokit import load_published

    model = load_published(SHARED / "golden/coex_pilot.ckpt", channel_order="rgb")
    left, right, truth = smooth_scene(448, 1056)
    tile = {"tile": (288, 736), "max_disparity": model.max_disparity, "multiple": model.multiple}
    rows, columns = tile_grid((448, 1056), **tile)
    assert len(rows) == len(columns) == 2
    with torch.inference_mode():
        whole = model(left, right).disparity[0]
        tiled = match_tiles(model, left, right, **tile).disparity[0]
        bare = match_tiles(model, left, right, **{**tile, "tile": (256, 672)}, overlap=0).disparity[0]
    visible = truth < torch.arange(1056)
    assert (whole - truth)[visible].abs().mean() < 0.5

    def seam(tiled: Tensor) -> float:
        """The largest difference that tiling makes, ties of the top two candidates aside."""
        return torch.quantile((tiled - whole).abs()[visible], 0.999).item()

    assert seam(tiled) < 0.1
    assert seam(bare) > 0.1
