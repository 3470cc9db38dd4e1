"""`stereokit list`."""

import argparse

from stereokit.errors import ConfigError
from stereokit.registry import REGISTRIES, list_components

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit list`."""
    parser.add_argument("slot", nargs="?", metavar="SLOT", help=f"one of {', '.join(REGISTRIES)} (default: all)")
    parser.add_argument("pattern", nargs="?", default="*", metavar="PATTERN", help="such as 'psm*', in quotes")


def run(options: argparse.Namespace) -> None:
    """Prints the names in a slot, or in all of them.

    Raises:
        ConfigError: there is no such slot, or nothing in it has such a name.
    """
    if options.slot is None:
        for slot in REGISTRIES:
            print(f"{slot:13}{'  '.join(list_components(slot))}")
        return
    names = list_components(options.slot, options.pattern)
    if not names:
        raise ConfigError(
            f"no {options.slot} match {options.pattern!r}; there are {', '.join(list_components(options.slot))}"
        )
    print("\n".join(names))
