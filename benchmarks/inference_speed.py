"""Times a network, with one set of weights, in the plain form of published code and as stereokit prepares it.

    python benchmarks/inference_speed.py
    python benchmarks/inference_speed.py --model psmnet --size 256 512 --skip compiled
    python benchmarks/inference_speed.py --device cuda --rounds 30

The plain form is written afresh from how the published networks compute: the correlation stacks all shifted features,
a full sort finds the top k, batch norms run on their own, the superpixel upsampling enlarges nine maps to full size,
and memory formats are PyTorch's defaults. Each form has a process of its own, and they take turns. The errors are
against the plain form, on noise as images, which lie on the device already.
"""

import argparse
import os
import sys
import tempfile
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from turns import serve, take_turns

from stereokit import (
    CorrelationVolume,
    StereoKitError,
    StereoModel,
    SuperpixelUpsampler,
    TopKSoftArgmin,
    build_model,
    load_published,
)
from stereokit.backends.compiled import compile_network
from stereokit.data.inputs import as_array
from stereokit.optimize import keep_freed_memory, prepare_for_inference
from stereokit.runtime.device import choose_device
from stereokit.runtime.processor import cpu_has

RIVAL = "published form"
# form: whether the network is plain, prepared, compiled; its precision; whether freed memory is kept
CPU_FORMS: dict[str, dict[str, Any]] = {
    RIVAL: {"kind": "published"},
    f"{RIVAL}, memory kept": {"kind": "published", "keep": True},
    "stereokit": {"kind": "plain"},
    "prepared": {"kind": "prepared"},
    "prepared, memory kept": {"kind": "prepared", "keep": True},
    "compiled, memory kept": {"kind": "compiled", "keep": True},
    "bfloat16, memory kept": {"kind": "prepared", "keep": True, "precision": "bfloat16"},
}
# where torch keeps freed memory anyway
OTHER_FORMS: dict[str, dict[str, Any]] = {
    RIVAL: {"kind": "published"},
    "stereokit": {"kind": "plain"},
    "prepared": {"kind": "prepared"},
    "prepared, float16": {"kind": "prepared", "precision": "float16"},
    "compiled": {"kind": "compiled"},
    "compiled, bfloat16": {"kind": "compiled", "precision": "bfloat16"},
    "compiled, float16": {"kind": "compiled", "precision": "float16"},
}


class StackedCorrelation(nn.Module):
    """Cosine similarity with all shifted right features stacked first: (B, C, D, H, W)."""

    def __init__(self, cost: CorrelationVolume) -> None:
        super().__init__()
        self.projection = cost.projection
        self.in_channels, self.out_channels, self.planes = cost.in_channels, cost.out_channels, cost.planes

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = (F.normalize(x, dim=1) for x in self.projection(left, right))
        batch, channels, height, width = right.shape
        shifted = F.unfold(F.pad(right, (self.planes - 1, 0)), (1, width))
        shifted = shifted.reshape(batch, channels, width, height, self.planes).permute(0, 1, 4, 3, 2).flip(2)
        return (left.unsqueeze(2) * shifted).sum(1, keepdim=True)


class SortedTopK(TopKSoftArgmin):
    """The top k by a full sort; no confidence."""

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The estimate, and zeros."""
        values, index = logits.sort(dim=1, descending=True)
        estimate = (values[:, : self.test_k].softmax(1) * index[:, : self.test_k]).sum(1)
        return estimate, torch.zeros_like(estimate)


class NinefoldUpsampler(SuperpixelUpsampler):
    """Superpixel upsampling of nine maps enlarged to full size."""

    def forward(self, x: Tensor, guides: Any) -> Tensor:
        """(B, h, w) to (B, H, W)."""
        weights = self.weights(guides)
        height, width = x.shape[-2:]
        padded = F.pad(x.unsqueeze(1), (1, 1, 1, 1), mode="constant" if self.padding == "zeros" else "replicate")
        nine = F.unfold(padded, 3).reshape(-1, 9, height, width)
        return (F.interpolate(nine, size=weights.shape[-2:], mode="nearest") * weights).sum(1)


def published_form(model: StereoModel) -> StereoModel:
    """The same weights, computed as in published code."""
    if isinstance(model.cost, CorrelationVolume):
        model.cost = StackedCorrelation(model.cost)
    if isinstance(model.regression, TopKSoftArgmin):
        model.regression = SortedTopK(model.regression.k, test_k=model.regression.test_k)
    if isinstance(model.upsampler, SuperpixelUpsampler):
        model.upsampler.__class__ = NinefoldUpsampler
    return model


def network(options: argparse.Namespace) -> Any:
    if options.weights and os.path.isdir(options.weights):
        return StereoModel.from_pretrained(options.weights)
    if options.weights:
        return load_published(options.weights, options.model, options.channel_order)
    torch.manual_seed(0)
    model = build_model(options.model, max_disparity=options.max_disparity)
    # statistics that fit: without them numbers explode in random networks that are deep
    with torch.no_grad():
        model.train()(*torch.rand(2, 2, 3, 64, 128))
    return model


def forms_of(device: torch.device) -> dict[str, dict[str, Any]]:
    """The forms that make a difference on a device."""
    if device.type != "cpu":
        return OTHER_FORMS
    return {form: how for form, how in CPU_FORMS.items() if "precision" not in how or cpu_has(torch.bfloat16)}


def name_of(device: torch.device) -> str:
    """What the network runs on."""
    if device.type == "cpu":
        return f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}"
    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


def work(options: argparse.Namespace, device: torch.device) -> None:
    """One form, in a process of its own."""
    form = forms_of(device)[options.worker]
    if form.get("keep"):
        keep_freed_memory()
    model = network(options).to(device).eval()
    start = time.perf_counter()
    if form["kind"] == "published":
        model = published_form(model)
    elif form["kind"] != "plain":
        model = prepare_for_inference(model, precision=form.get("precision", "float32"))
    report = {"preparation": time.perf_counter() - start}
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 1, 3, *options.size, generator=generator).to(device).unbind()
    with torch.inference_mode():
        if form["kind"] == "compiled":
            model = compile_network(model, device)
            start = time.perf_counter()
            model(*images)
            report["compilation"] = time.perf_counter() - start
        for _ in range(2):
            disparity = model(*images).disparity
        np.save(options.result, as_array(disparity))
        serve(report, lambda: model(*images))


def compare(options: argparse.Namespace, device: torch.device) -> None:
    forms = [form for form in forms_of(device) if form == RIVAL or not form.startswith(tuple(options.skip))]
    height, width = options.size
    print(f"{options.model}, {height} x {width}, D = {options.max_disparity}, {name_of(device)}, ", end="")
    print(f"torch {torch.__version__}, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        results = {form: f"{folder}/{i}.npy" for i, form in enumerate(forms)}
        reports, medians = take_turns(forms, options.rounds, lambda form: ["--worker", form, "--result", results[form]])
        disparities = {form: np.load(results[form]) for form in forms}
    print(f"load at the end {os.getloadavg()[0]:.1f}\n")
    print("| form | median [s] | of the published form | processor [s] | of the published form | ", end="")
    print("error at 99.9 % [px] | made ready in [s] |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for form, (wall, processor) in medians.items():
        shares = medians[form] / medians[RIVAL]
        error = np.quantile(np.abs(disparities[form] - disparities[RIVAL]), 0.999)
        ready = reports[form]["preparation"] + reports[form].get("compilation", 0)
        row = f"{wall:.4f} | {shares[0]:.2f} | {processor:.4f} | {shares[1]:.2f} | {error:.1e} | {ready:.1f}"
        print(f"| {form} | {row} |")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="coex")
    parser.add_argument("--weights", help="saved network or published checkpoint (default: random weights)")
    parser.add_argument("--channel-order", default="bgr", choices=("bgr", "rgb"), help="of published checkpoints")
    parser.add_argument("--size", nargs=2, type=int, default=(384, 1248), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--device", default="cpu", help="cpu, cuda or another one of torch's")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--skip", action="append", default=[], help="forms whose name starts like this; repeat")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--result", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        device = choose_device(options.device)
        if options.worker:
            work(options, device)
        else:
            compare(options, device)
    except StereoKitError as error:
        print(f"inference_speed: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
