"""How many frames a second the viewer's page shows, and how fast its cloud turns, in headless Chromium."""

import argparse
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from browser import processor_seconds, viewer_page
from torch import Tensor, nn

from stereokit import Predictor, StereoOutput
from stereokit.calibration import Calibration
from stereokit.viewer import Desk, Frames

HEIGHT, WIDTH = 625, 800
LIVE = """async seconds => {
  const from = performance.now(), first = app.frame.number;
  await new Promise(done => setTimeout(done, seconds * 1000));
  const frames = app.frame.number - first;
  return {frames, rate: frames / (performance.now() - from) * 1000};
}"""
STILL = """async () => {
  const frame = () => new Promise(requestAnimationFrame);
  app.pause(true);
  while (app.playing) await frame();
  const {gl} = app.cloud, dot = new Uint8Array(4);
  const timed = work => {
    const times = [];
    for (let i = 0; i < 15; i++) { const start = performance.now(); work(); times.push(performance.now() - start); }
    return times.sort((a, b) => a - b)[7];
  };
  const turn = timed(() => {
    app.cloud.rotate(0.01, 0);
    app.cloud.draw([0, 0, 0]);  // all points
    if (gl) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, dot);
  });
  const range = timed(() => app.compose());
  const box = app.cloud.canvas.getBoundingClientRect();
  const pick = timed(() => app.cloud.pick({clientX: box.left + box.width / 2, clientY: box.top + box.height / 2}));
  return {turn, range, pick};
}"""


class Free(nn.Module):
    """Costs nothing: a plane that is slanted, the same for every pair."""

    def __init__(self) -> None:
        super().__init__()
        self.plane = torch.linspace(10, 100, HEIGHT)[:, None].expand(HEIGHT, WIDTH).clone()

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        """The plane, whatever the views show."""
        if left.shape[-2:] != self.plane.shape:
            return StereoOutput(torch.ones_like(left[:, 0], dtype=torch.float32))
        return StereoOutput(self.plane[None], confidence=torch.full((1, HEIGHT, WIDTH), 0.9))


def video() -> Iterator[Any]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (4, HEIGHT // 8 + 1, WIDTH // 8, 3), dtype=np.uint8)
    images = images.repeat(8, axis=1).repeat(8, axis=2)[:, :HEIGHT]
    index = 0
    while True:
        yield SimpleNamespace(left=images[index % 4], right=images[(index + 1) % 4], index=index)
        index += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--webgl", action="store_true", help="draw points by WebGL in software, which the page avoids")
    options = parser.parse_args()
    camera = Calibration(fx=800.0, baseline=0.1, cx0=400.0, cx1=400.0, cy=312.0)
    desk = Desk(Frames(video(), name="frames", live=True), Predictor(Free(), "cpu"), camera)
    with viewer_page(desk, width=1440, height=900, webgl=options.webgl) as page:
        page.wait_for_function("() => window.app && app.frame && app.frame.number > 3")
        before = processor_seconds()
        live = page.evaluate(LIVE, options.seconds)
        spent = processor_seconds() - before
        step = page.evaluate("() => app.cloud.step")
        found = page.evaluate(STILL)
    some = "all points" if step == 1 else f"one point of {step}"
    print(f"{WIDTH * HEIGHT:,} points: {live['rate']:.1f} frames/s live, {some} drawn; processor time of each frame:")
    for kind, seconds in spent.most_common():
        print(f"  {1e3 * seconds / live['frames']:4.0f} ms  {kind}")
    print(f"all points turned and drawn in {found['turn']:.0f} ms")
    print(f"a range of colours moved in {found['range']:.0f} ms, a point of the cloud found in {found['pick']:.0f} ms")


if __name__ == "__main__":
    main()
