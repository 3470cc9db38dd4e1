"""The `stereokit` command: a file per job."""

from stereokit.cli.program import main

__all__ = ["main"]
