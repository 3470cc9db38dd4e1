"""How many small changes of the code its tests notice: `python benchmarks/mutants.py ROOM ... --sample N`.

Each mutant has one operator, number or condition changed. The tests of its room run on it, and should fail. Mutants are
drawn by seed, and what was found is appended to a file, so that a run that was ended goes on.

A mutant is a fork of a process that has imported PyTorch: a runner that starts Python anew for each, as cosmic-ray
does, takes some seconds more every time.
"""

import argparse
import ast
import copy
import json
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

ROOMS: dict[str, tuple[list[str], list[str]]] = {
    "regression": (["regression/*.py"], ["tests/regression"]),
    "costs": (["costs/*.py"], ["tests/costs"]),
    "metrics": (["metrics/*.py"], ["tests/metrics"]),
    "losses": (["losses/*.py"], ["tests/losses"]),
    "readers": (
        ["data/pfm.py", "data/npy.py", "data/disparity_*.py", "data/images.py", "data/bit_depth.py",
         "data/image_formats/*.py"],
        ["tests/data/test_pfm.py", "tests/data/test_npy.py", "tests/data/test_disparity_files.py",
         "tests/data/test_disparity_png.py", "tests/data/test_images.py", "tests/data/test_inputs.py",
         "tests/data/image_formats"],
    ),
    "aggregation": (["aggregation/*.py"], ["tests/aggregation"]),
    "guidance": (["guidance/*.py"], ["tests/guidance"]),
    "upsampling": (["upsampling/*.py"], ["tests/upsampling"]),
    "layers": (["layers/*.py"], ["tests/layers"]),
    "candidates": (["candidates/*.py"], ["tests/candidates"]),
}  # fmt: skip
"""Files under `stereokit/`, and the tests that should notice; the doctests of a mutated file run too."""

_COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
             ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
             ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}  # fmt: skip


def main() -> None:
    """Draws mutants, tries them, and prints the score of each room."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rooms", nargs="*", default=list(ROOMS), metavar="ROOM", help=", ".join(ROOMS))
    parser.add_argument("--sample", type=int, default=40, help="mutants of each room (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=int, default=300, help="after which a mutant counts as noticed: it hangs")
    parser.add_argument("--log", default="mutants.jsonl", help="what was found so far (default: %(default)s)")
    options = parser.parse_args()
    _import_what_never_changes()
    log = Path(options.log)
    done = {(f["file"], f["number"]): f for f in map(json.loads, log.read_text().splitlines())} if log.exists() else {}
    print("| room | mutants | tried | noticed | score |\n|---|---:|---:|---:|---:|")
    for room in options.rooms:
        mutants = sorted((str(path.relative_to(ROOT)), n) for path in _files(room) for n, _ in enumerate(_places(path)))
        drawn = random.Random(f"{options.seed} {room}").sample(mutants, min(options.sample, len(mutants)))
        outcomes: Counter[bool] = Counter()
        if any(place not in done for place in drawn) and _fails(room, drawn[0][0], None, options.seconds):
            raise SystemExit(f"the tests of {room} fail before anything is changed")
        for file, number in drawn:
            if (file, number) not in done:
                done[file, number] = _try(room, file, number, options.seconds)
                with log.open("a") as opened:
                    opened.write(json.dumps(done[file, number]) + "\n")
            found = done[file, number]
            outcomes[found["noticed"]] += 1
            if not found["noticed"]:
                print(f"  {file}:{found['line']}: {found['change']}", flush=True)
        score = 100 * outcomes[True] / max(1, len(drawn))
        print(f"| {room} | {len(mutants)} | {len(drawn)} | {outcomes[True]} | {score:.0f} % |", flush=True)


def _files(room: str) -> list[Path]:
    return sorted({path for pattern in ROOMS[room][0] for path in (ROOT / "stereokit").glob(pattern)})


def _import_what_never_changes() -> None:
    import cv2
    import hypothesis.extra.numpy  # noqa: F401
    import pytest  # noqa: F401
    import timm  # noqa: F401
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _try(room: str, file: str, number: int, seconds: int) -> dict[str, object]:
    """Runs the tests of a room on one mutant, in a process of its own."""
    tree, line, change = _mutant(ROOT / file, number)
    began = time.monotonic()
    noticed = _fails(room, file, tree, seconds)
    took = round(time.monotonic() - began, 1)
    where = {"room": room, "file": file, "number": number, "line": line, "change": change}
    return {**where, "noticed": noticed, "seconds": took}


def _fails(room: str, file: str, tree: ast.Module | None, seconds: int) -> bool:
    """Whether the tests of a room fail, or take too long."""
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        signal.alarm(seconds)
        os._exit(_run_tests(room, file, tree))
    return os.waitpid(child, 0)[1] != 0


def _run_tests(room: str, file: str, tree: ast.Module | None) -> int:
    import pytest

    sys.path.insert(0, str(ROOT))
    os.chdir(ROOT)
    if tree is not None:
        sys.meta_path.insert(0, _Mutated(file, tree))
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header"]
    try:
        return int(pytest.main([*options, *ROOMS[room][1], file]))
    except BaseException:
        return 1


class _Mutated(MetaPathFinder):
    """Imports one module from a changed tree."""

    def __init__(self, file: str, tree: ast.Module) -> None:
        self.path = ROOT / file
        self.name = ".".join(Path(file).with_suffix("").parts).removesuffix(".__init__")
        self.tree = tree

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        if name != self.name:
            return None
        tree = self.tree

        class Loader(SourceFileLoader):
            def get_code(self, fullname: str) -> object:
                return compile(tree, self.path, "exec")

        package = [str(self.path.parent)] if self.path.name == "__init__.py" else None
        loader = Loader(name, str(self.path))
        return spec_from_file_location(name, self.path, loader=loader, submodule_search_locations=package)


def _mutant(path: Path, number: int) -> tuple[ast.Module, int, str]:
    """The changed module, the line, and the change in words."""
    tree = ast.parse(path.read_text())
    node, change = list(_changes(tree))[number]
    before = ast.unparse(node)
    change()
    return ast.fix_missing_locations(tree), node.lineno, f"{before} -> {ast.unparse(node)}"


def _places(path: Path) -> Iterator[object]:
    yield from _changes(ast.parse(path.read_text()))


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, Callable[[], None]]]:
    """Every node that can be changed, in one fixed order, and what changes it in place."""
    for child in ast.iter_child_nodes(tree):
        # messages, annotations and decorators are not what a module computes
        if isinstance(child, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom | ast.AnnAssign | ast.arg):
            continue
        if isinstance(child, ast.Assign) and getattr(child.targets[0], "id", "") == "__all__":
            continue
        yield from _changes_of(child)
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            inner = copy.copy(child)
            inner.decorator_list = []
            if isinstance(inner, ast.FunctionDef):
                inner.returns = None
            yield from _changes(inner)
        else:
            yield from _changes(child)


def _changes_of(node: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, Callable[[], None]]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARED:
        yield node, lambda: node.ops.__setitem__(0, _COMPARED[type(node.ops[0])]())
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _COMPUTED:
        yield node, lambda: setattr(node, "op", _COMPUTED[type(node.op)]())
    elif isinstance(node, ast.BoolOp):
        yield node, lambda: setattr(node, "op", ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        # twice is not at all
        twice = ast.UnaryOp(type(node.op)(), node.operand)
        yield node, lambda: setattr(node, "operand", twice)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield node, lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        changed = not node.value if isinstance(node.value, bool) else node.value + 1
        yield node, lambda: setattr(node, "value", changed)


if __name__ == "__main__":
    main()
