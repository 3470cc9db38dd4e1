"""`stereokit train`."""

import argparse
import shlex
from typing import Any

from stereokit.cli.loading import check_published_options, load_chosen_network
from stereokit.cli.options import add_published_options, network_help
from stereokit.errors import ConfigError
from stereokit.training.machine import Machine
from stereokit.training.recipe import list_recipes, load_recipe, with_length

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit train`."""
    parser.add_argument(
        "--recipe", required=True, help=f"{', '.join(list_recipes())}; or a file of one's own that ends in .toml"
    )
    parser.add_argument("--out", required=True, help="folder for all that the run writes")
    parser.add_argument(
        "--data",
        action="append",
        default=[],
        metavar="KIND[/SPLIT][,OPTION=VALUE]:ROOT",
        help="data set to train on, such as kitti2015/train:/data/kitti2015; may be given several times",
    )
    parser.add_argument(
        "--validate",
        action="append",
        default=[],
        metavar="KIND[/SPLIT][,OPTION=VALUE]:ROOT",
        help="data set to validate on as it goes; may be given several times",
    )
    parser.add_argument("--textures", metavar="DIR", help="photographs to use in rendered scenes besides patterns")
    parser.add_argument("--weights", help=f"network to go on from: {network_help()}")
    parser.add_argument(
        "--network-from",
        choices=("recipe", "weights"),
        default="recipe",
        help="which network to train where that of --weights is not the recipe's: recipe refuses it, weights trains it "
        "as it is (default: %(default)s)",
    )
    add_published_options(parser)
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out, if there is one")
    length = parser.add_argument_group("length")
    length.add_argument(
        "--minutes",
        type=float,
        help="fit schedule and steps into this time, with the last validation (without starting up)",
    )
    length.add_argument("--steps", type=int, help="of the optimiser (default: the recipe's)")
    length.add_argument("--batch", type=int, help="pairs a step, over all devices (default: the recipe's)")
    parser.add_argument("--seed", type=int, default=0, help="of all that is random (default: %(default)s)")
    machine = parser.add_argument_group("machine")
    machine.add_argument("--accelerator", default="auto", help="cpu, gpu, ... (default: a GPU if there is one)")
    machine.add_argument("--devices", default="auto", help="how many on each machine (default: 1 CPU, or all GPUs)")
    machine.add_argument("--nodes", type=int, default=1, help="machines, each started by itself (default: %(default)s)")
    machine.add_argument(
        "--precision", default="32", help="32, bf16-mixed, 16-mixed, ... as Lightning calls them (default: %(default)s)"
    )
    machine.add_argument("--compile", action="store_true", help="train through torch.compile: minutes to start, faster")
    machine.add_argument("--workers", type=int, help="processes that read pairs, for each device (default: by cores)")
    parser.add_argument(
        "--checkpoint-every", type=int, default=200, metavar="STEPS", help="(default: every %(default)s steps)"
    )
    parser.add_argument(
        "--validate-every", type=int, default=1000, metavar="STEPS", help="(default: every %(default)s steps)"
    )


def run(options: argparse.Namespace) -> None:
    """The command, with the options that `stereokit train --help` lists."""
    # below, for they need Lightning
    from stereokit.training import train
    from stereokit.training.trainer import is_first_process

    recipe = with_length(load_recipe(options.recipe), steps=options.steps, batch=options.batch)
    options.model = recipe.model["name"]
    if options.weights is None:
        check_published_options(options)
    outcome = train(
        recipe,
        options.out,
        data=options.data,
        validation=options.validate,
        textures=options.textures,
        model=None if options.weights is None else load_chosen_network(options).train(),
        weights=options.weights,
        network_from=options.network_from,
        seed=options.seed,
        minutes=options.minutes,
        resume=options.resume,
        machine=Machine(
            accelerator=options.accelerator,
            devices=_devices(options.devices),
            nodes=options.nodes,
            precision=options.precision,
            compile=options.compile,
            workers=options.workers,
            checkpoint_every=options.checkpoint_every,
            validate_every=options.validate_every,
        ),
        command=shlex.join(["stereokit", *options.arguments]),
    )
    if not is_first_process():
        return
    record: Any = outcome.record
    print(
        f"{record['steps']} steps, {record['pairs_seen']} pairs, {record['seconds'] / 60:.1f} minutes; "
        f"wrote {outcome.network}"
    )
    errors = record["validation"]
    sets = {name.rpartition("/")[0] for name in errors} - {"validation"}
    for name, value in errors.items():
        mean = name.startswith("validation/")
        # of a single set the mean says nothing new
        if not mean or len(sets) > 1:
            print(f"{name}: {value:.3f}{' (mean over the sets)' if mean else ''}")


def _devices(given: str) -> int | str:
    if given == "auto":
        return given
    if not given.isdecimal() or int(given) < 1:
        raise ConfigError(f"--devices is a number of devices, or auto; got {given!r}")
    return int(given)
