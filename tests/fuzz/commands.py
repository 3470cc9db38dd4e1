"""Whole commands on a folder that holds a damaged file."""

import contextlib
import io
import json
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from stereokit.cli import main
from stereokit.data import read_disparity, read_image, write_disparity
from stereokit.data.npy import read_npz
from stereokit.errors import StereoKitError
from tests.data.encoded import encode
from tests.fuzz.networks import save_tiny

__all__ = ["command_inputs", "left_images", "run_command", "truth"]

LEFT = np.random.default_rng(0).integers(0, 256, (33, 40, 3), np.uint8)


class Refused(StereoKitError):
    """What a command said of its input."""


def command_inputs() -> dict[str, bytes]:
    """A pair of images."""
    return {"left.png": encode(".png", LEFT), "right.png": encode(".png", np.roll(LEFT, -3, 1))}


def left_images() -> list[bytes]:
    """The left one in formats that notice damage more and less."""
    return [encode(suffix, LEFT) for suffix in (".png", ".jpg", ".ppm")]


def truth(suffix: str) -> bytes:
    """A file of disparity of their size."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"disparity{suffix}"
        write_disparity(path, np.full(LEFT.shape[:2], 3.0))
        return path.read_bytes()


def run_command(name: str, path: Path) -> str:
    """Runs a command on the folder of a damaged file, sees that what it wrote can be read, and gives what it said.

    Raises:
        Refused: it ended with code 2 and one line, and wrote nothing.
        AssertionError: it did anything else.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        said, shown = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(shown):
            code = main(_arguments(name, path, out))
        written = [file for file in out.rglob("*") if file.is_file()]
        message = "\n".join(line for line in shown.getvalue().splitlines() if line.startswith("stereokit "))
        assert code in (0, 2), f"it ended with {code}: {shown.getvalue()[-300:]}"
        assert "Traceback" not in shown.getvalue(), shown.getvalue()[-300:]
        if code == 2:
            assert message.count("\n") == 0, message[-300:]
            assert message.isprintable(), message[-300:]
            assert not written, f"it wrote {written}, and failed: {message[-300:]}"
            raise Refused(message)
        for file in written:
            _read(file)
        return f"{len(written)} files"


@cache
def _tiny() -> str:
    folder = tempfile.mkdtemp()
    save_tiny(folder)
    return folder


def _arguments(name: str, path: Path, out: Path) -> list[str]:
    pair = [str(path.parent / f"{view}.png") for view in ("left", "right")]
    network = ["--weights", _tiny(), "--device", "cpu"]
    if name == "predict":
        return ["predict", str(path), pair[1], *network, "--out", str(out)]
    if name == "depth":
        return ["predict", *pair, *network, "--calibration", str(path), "--depth", "--cloud", "--out", str(out)]
    if name == "eval":
        return ["eval", *network, "--data", f"folder:{path.parent}", "--out", str(out)]
    if name == "data":
        return ["data", "check", "folder", str(path)]
    if name == "convert":
        return ["convert", str(path), str(out)]
    assert name == "weights"
    return ["predict", *pair, "--weights", str(path.parent), "--device", "cpu", "--out", str(out)]


def _read(file: Path) -> None:
    if file.name.endswith("_depth.png") or file.suffix in (".ply", ".csv", ".md", ".safetensors"):
        assert file.stat().st_size > 0
    elif file.suffix == ".json":
        json.loads(file.read_text())
    elif file.suffix == ".npz":
        read_npz(file)
    elif file.name.endswith("_picture.png"):
        read_image(file)
    else:
        read_disparity(file)
