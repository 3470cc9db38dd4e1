"""The readers, each with small valid files to damage."""

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from stereokit.backends.metadata import KEY, ExportMetadata
from stereokit.data import open_dataset, read_calibration, read_disparity, read_image
from stereokit.data.npy import read_npy, read_npz
from stereokit.data.pfm import read_pfm
from stereokit.weights.folder import load_folder
from stereokit.weights.published import load_published
from tests.data.encoded import animated_png, chunk, encode, png, tiff
from tests.fuzz.commands import command_inputs, left_images, run_command, truth
from tests.fuzz.mutate import mutated, with_checksums
from tests.fuzz.networks import published_checkpoint, saved_network
from tests.fuzz.structured import json_damaged, safetensors_damaged, zip_damaged

__all__ = ["COMMANDS", "FILES", "KINDS", "LIBRARY", "Kind"]


@dataclass(frozen=True)
class Kind:
    """A reader under test.

    Attributes:
        seeds: valid files.
        read: what is called with the damaged file.
        name: of the file, in a folder of its own.
        beside: other files of that folder.
        repair: of half of the damaged files, to get past what finds damage first.
        damage: what makes input `number` out of the seeds and the file's name.
        quick: how many inputs the default suite tries.
        long: for how many of the long run's inputs one is tried: networks and commands take their time.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], Any]
    name: str
    beside: Callable[[], dict[str, bytes]] = dict
    repair: Callable[[bytes], bytes] | None = None
    damage: Callable[[list[bytes], str, int], bytes] = mutated
    quick: int = 120
    long: int = 1

    def input(self, seeds: list[bytes], number: int) -> bytes:
        data = self.damage(seeds, self.name, number)
        return self.repair(data) if self.repair and number % 2 else data


PICTURE = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)
GREY = PICTURE[:, :, 0]
DEEP = PICTURE.astype(np.uint16) * 257
ALPHA = np.dstack([PICTURE, GREY])
MAP = np.linspace(0, 9, 12, dtype=np.float32).reshape(3, 4)


def _image_or_map(path: Path) -> Any:
    image = read_image(path)
    assert image.ndim == 3 and image.shape[2] == 3 and image.dtype in (np.uint8, np.float32)  # noqa: PT018
    return image


def _disparity(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def checked(path: Path) -> Any:
        values = read(path)
        assert values.ndim == 2 and values.dtype == np.float32 and not np.isinf(values).any()  # noqa: PT018
        return values

    return checked


def _scaled(path: Path) -> Any:
    return read_disparity(path, scale=4)


def _list(path: Path) -> Any:
    dataset = open_dataset(f"folder:{path}", allow_missing=True)
    return [(entry.name, *map(str, entry.paths)) for entry in dataset.entries]


def _saved(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def _zipped(method: int, name: str = "disparity.npy", array: Any = MAP) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr(name, _saved(array))
    return buffer.getvalue()


def _pngs() -> list[bytes]:
    images = [encode(".png", samples) for samples in (PICTURE, GREY, DEEP, ALPHA)]
    return [*images, animated_png(), png(2, 2, 8, 3, b"\0\0\1\0\1\0", chunk(b"PLTE", bytes(range(6))))]


def _jpegs() -> list[bytes]:
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    large = cv2.resize(PICTURE, (40, 40))
    return [encode(".jpg", PICTURE), encode(".jpg", GREY), encode(".jpg", large, progressive)]


def _tiffs() -> list[bytes]:
    written = [encode(".tif", samples) for samples in (PICTURE, GREY, DEEP)]
    layouts = [{"compression": 8}, {"compression": 32773, "rows": 2}, {"tile": 16}, {"planar": True}, {"order": ">"}]
    return [*written, tiff(MAP), tiff(DEEP, tags={317: [2]}), *(tiff(PICTURE, **layout) for layout in layouts)]


def _webps() -> list[bytes]:
    qualities = ([cv2.IMWRITE_WEBP_QUALITY, quality] for quality in (50, 101))
    return [encode(".webp", samples, quality) for quality in qualities for samples in (PICTURE, ALPHA)]


def _pnms() -> list[bytes]:
    text = b"P2\n# text\n3 2\n9\n1 2 3 4 5 6\n"
    return [encode(".ppm", PICTURE), encode(".pgm", GREY), encode(".ppm", DEEP), text, b"P4\n9 2\n\1\2\3\4"]


def _pfms() -> list[bytes]:
    return [head + MAP.tobytes() for head in (b"Pf\n4 3\n-1\n", b"Pf # a\n4 3\n1.5\n")]


def _lists() -> list[bytes]:
    return [
        b'# a list\nleft.png right.png truth.png scale=4\n"my data/l.png" r.png name=second calibration=c.txt\n',
        b"a\\left.png,a\\right.png,a\\d.pfm\nb/left.png, b/right.png\n",
    ]


def _calibrations() -> list[bytes]:
    def opencv(name: str, shift: float) -> bytes:
        data = f"700., 0., 4., {shift}, 0., 700., 3., 0., 0., 0., 1., 0."
        return f"{name}: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [ {data} ]\n".encode()

    return [
        b"P0: 700 0 4 0 0 700 3 0 0 0 1 0\nP1: 700 0 4 -350 0 700 3 0 0 0 1 0\n",
        b"cam0=[700 0 4; 0 700 3; 0 0 1]\ncam1=[700 0 5; 0 700 3; 0 0 1]\ndoffs=1\nbaseline=100\nwidth=9\nheight=6\n",
        b"%YAML:1.0\n---\nimage_width: 9\n" + opencv("P1", 0) + opencv("P2", -70),
    ]


FILES = {
    "pfm": Kind(_pfms, _disparity(read_pfm), "a.pfm"),
    "png": Kind(_pngs, _image_or_map, "a.png", repair=with_checksums),
    "jpeg": Kind(_jpegs, _image_or_map, "a.jpg"),
    "tiff": Kind(_tiffs, _image_or_map, "a.tif"),
    "webp": Kind(_webps, _image_or_map, "a.webp"),
    "bmp": Kind(lambda: [encode(".bmp", PICTURE), encode(".bmp", GREY)], _image_or_map, "a.bmp"),
    "pnm": Kind(_pnms, _image_or_map, "a.ppm"),
    "disparity": Kind(lambda: [*_pngs(), *_tiffs(), *_pnms()], _disparity(_scaled), "d.png", repair=with_checksums),
    "npy": Kind(lambda: [_saved(MAP), _saved(np.asfortranarray(MAP.astype(">f8")))], _disparity(read_npy), "a.npy"),
    "npz": Kind(
        lambda: [_zipped(zipfile.ZIP_STORED), _zipped(zipfile.ZIP_DEFLATED, "a.npy"), _zipped(zipfile.ZIP_LZMA)],
        _disparity(read_npz),
        "a.npz",
    ),
    "list": Kind(_lists, _list, "a.txt"),
    "calibration": Kind(_calibrations, read_calibration, "calib.txt"),
}
"""The formats of data."""


def _recipes() -> list[bytes]:
    from stereokit.training import recipe

    return [path.read_bytes() for path in sorted((Path(recipe.__file__).parent / "recipes").glob("*.toml"))]


def _recipe(path: Path) -> Any:
    from stereokit.training.recipe import load_recipe

    return str(load_recipe(str(path)))


def _metadata(path: Path) -> Any:
    text = path.read_bytes().decode("utf-8", errors="replace")
    return str(ExportMetadata.read({KEY: text}, str(path)))


def _metadata_seeds() -> list[bytes]:
    network = {"backbone": {"name": "unet"}, "max_disparity": 192}
    return [ExportMetadata(network, 192, (384, 1248), "int8", 18).to_json().encode()]


def _folder(path: Path) -> Any:
    return str(load_folder(str(path.parent)).config)


def _checkpoints() -> list[bytes]:
    state = {"stereo.feature.a.weight": torch.ones(2, 2), "stereo.b": torch.tensor(1.0)}
    out = []
    for content in (state, {"state_dict": state, "epoch": 3, "hyper_parameters": {"a": [1, 2.5, None]}}):
        buffer = io.BytesIO()
        torch.save(content, buffer)
        out.append(buffer.getvalue())
    return [*out, published_checkpoint()]


def _beside(name: str) -> Callable[[], dict[str, bytes]]:
    return lambda: {other: content for other, content in saved_network().items() if other != name}


def _saved_files(name: str, **options: Any) -> Kind:
    return Kind(lambda: [saved_network()[name]], _folder, name, beside=_beside(name), **options)


LIBRARY = {
    "recipe": Kind(_recipes, _recipe, "a.toml"),
    "metadata": Kind(_metadata_seeds, _metadata, "metadata.json", damage=json_damaged),
    "checkpoint": Kind(_checkpoints, load_published, "a.ckpt", damage=zip_damaged, quick=20, long=100),
    "safetensors": _saved_files("model.safetensors", damage=safetensors_damaged, quick=40, long=20),
    "config": _saved_files("config.json", damage=json_damaged, quick=40, long=20),
}
"""What the library keeps of networks, runs and exports."""


def _network_and_pair() -> dict[str, bytes]:
    return {**command_inputs(), **_beside("config.json")()}


def _command(name: str, of: Kind) -> Kind:
    return replace(of, read=partial(run_command, name), beside=command_inputs, quick=4, long=100)


COMMANDS = {
    "predict": _command("predict", replace(FILES["png"], seeds=left_images)),
    "depth": _command("depth", FILES["calibration"]),
    "eval": _command("eval", Kind(lambda: [truth(".pfm")], run_command, "disparity.pfm")),
    "eval-npz": _command("eval", Kind(lambda: [truth(".npz")], run_command, "disparity.npz", damage=zip_damaged)),
    "data": _command("data", Kind(lambda: [b"left.png right.png name=a\n"], run_command, "a.txt")),
    "convert": _command("convert", replace(LIBRARY["checkpoint"], name="a.ckpt")),
    "weights": replace(_command("weights", LIBRARY["config"]), beside=_network_and_pair),
}
"""Whole commands, each with one damaged file."""

KINDS = {**FILES, **LIBRARY, **COMMANDS}
