"""Turns a trained network into weights with a manifest.

python -m stereokit.weights.release RUN/network coex.mine_v1 --out FOLDER --results RESULTS.json
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from stereokit.errors import CheckpointError, ConfigError, StereoKitError
from stereokit.files import make_folder, write_json
from stereokit.runtime.provenance import file_sha256, state_sha256
from stereokit.weights.folder import WEIGHTS_NAME, load_folder, write_config, write_weights
from stereokit.weights.shipped import MANIFEST_NAME, Manifest, list_weights, load_weights, read_manifest

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = ["main", "release"]


def release(
    network: str | Path,
    name: str,
    out: str | Path,
    *,
    results: Mapping[str, Any],
    started_from: Path | None = None,
    mean_with: Sequence[str | Path] = (),
    command: str | None = None,
    licence: str = "Apache-2.0",
) -> Manifest:
    """Writes `model.safetensors` in float16, and `manifest.json`; with `config.json` the folder is a saved network too.

    Args:
        network: folder of a network that `stereokit train` saved, with its `training.json`.
        name: NETWORK.TAG.
        out: the folder, which must be new.
        results: measured errors, with the command that measures them.
        started_from: the folder of a release with what the training began with; weights that are at hand
            by name are found by themselves.
        mean_with: weights of the same network, such as those that the training began from, by name, or as the `Path` of
            a release's folder: what is written is the mean of them all.
        command: what does the training again, in place of the recorded one with its folders of one machine.
        licence: of the weights, as an SPDX identifier.

    Raises:
        CheckpointError: there is no trained network in the folder.
        ConfigError: a name that is not of this network, weights that float16 can't hold, a training that began with
            others than `started_from` or any at hand, or a mean with weights of another network.
        InputError: the files are there already, or can't be written.

    Source of the mean: Wortsman et al., "Model soups", ICML 2022.
    """
    model = load_folder(str(network))
    record = Path(network) / "training.json"
    try:
        training = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{str(record)!r}, the record of the training, can't be read: {error}") from error
    if command is not None:
        training["command"] = command
    if isinstance(mean_with, str):
        raise ConfigError(f"mean_with takes a list of weights, such as [{mean_with!r}]")
    kind = model.config["name"]
    if not name.startswith(f"{kind}.") or not name.removeprefix(f"{kind}."):
        raise ConfigError(f"weights of a {kind} are named {kind}.TAG, not {name!r}")
    named = list_weights(f"{kind}.*")
    training = _with_origin(training, named if started_from is None else [started_from, *named])
    if mean_with:
        training["mean_with"] = [_named(other, training) for other in mean_with]
    weights = _mean(model, mean_with)
    state = {key: value.half() if value.is_floating_point() else value for key, value in weights.items()}
    too_large = [key for key, value in state.items() if not value.isfinite().all()]
    if too_large:
        raise ConfigError(f"float16 can't hold {', '.join(too_large)}")
    make_folder(out)
    write_weights(state, Path(out), overwrite=False)
    write_config(model.config, Path(out), overwrite=False)
    manifest = Manifest(
        name=name,
        sha256=file_sha256(Path(out) / WEIGHTS_NAME),
        licence=licence,
        network=dict(model.config),
        images="RGB, uint8 or float in [0, 1]; the network normalises and pads",
        precision="float16",
        training=training,
        results=dict(results),
    )
    write_json(Path(out) / MANIFEST_NAME, manifest)
    return manifest


def _mean(model: "StereoNetwork", others: Sequence[str | Path]) -> dict[str, Tensor]:
    weights = model.state_dict()
    for number, name in enumerate(others, start=1):
        other = load_weights(name)
        if other.config != model.config:
            raise ConfigError(f"{str(name)!r} are not of the same network; their mean with its weights means nothing")
        for key, value in other.state_dict().items():
            if value.is_floating_point():
                weights[key] = weights[key] + (value - weights[key]) / (number + 1)
    return weights


def _named(weights: str | Path, training: dict[str, Any]) -> dict[str, Any]:
    """Name and hash of weights in the mean; with their record where nothing else tells it."""
    manifest = read_manifest(weights)
    known: dict[str, Any] = {"name": manifest["name"], "sha256": manifest["sha256"]}
    if weights in list_weights() or training.get("started_from", {}).get("sha256") == manifest["sha256"]:
        return known
    return {**known, "training": manifest["training"]}


def _with_origin(training: dict[str, Any], known: Sequence[str | Path]) -> dict[str, Any]:
    """The record, with that of the weights that the training began with."""
    start = training.get("start")
    if start is None:
        return training
    for weights in known:
        origin = read_manifest(weights)
        before = origin["training"]
        # those of a run by itself are released as halves, and trained on as they were
        as_trained = None if "mean_with" in before else before.get("weights_sha256")
        if start == as_trained or start == state_sha256(load_weights(weights).state_dict()):
            return {**training, "started_from": {key: origin[key] for key in ("name", "sha256", "training")}}
    raise ConfigError(
        f"the training began from weights that are not at hand (SHA-256 of their tensors: {start}), so that nobody "
        f"could tell where these are from; release those first, and name the folder (--started-from)"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="Turn a trained network into weights with a manifest.")
    parser.add_argument("network", help="folder of a network that `stereokit train` saved")
    parser.add_argument("name", help="NETWORK.TAG")
    parser.add_argument("--out", required=True, help="new folder")
    parser.add_argument("--results", required=True, help="JSON file of measured errors")
    parser.add_argument(
        "--started-from", metavar="FOLDER", help="release of what the training began with, where it has no name here"
    )
    parser.add_argument(
        "--mean-with",
        action="append",
        default=[],
        metavar="NAME",
        help="write the mean of the network's weights and these, named or in the folder of a release; repeat",
    )
    parser.add_argument(
        "--command", help="what does the training again, in place of the recorded one with its folders of one machine"
    )
    parser.add_argument("--licence", default="Apache-2.0", help="(default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        results = json.loads(Path(options.results).read_text(encoding="utf-8"))
        manifest = release(
            options.network,
            options.name,
            options.out,
            results=results,
            started_from=None if options.started_from is None else Path(options.started_from),
            mean_with=[Path(weights) if Path(weights).is_dir() else weights for weights in options.mean_with],
            command=options.command,
            licence=options.licence,
        )
    except (OSError, ValueError, StereoKitError) as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    print(f"wrote {options.out}, sha256 {manifest['sha256']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
