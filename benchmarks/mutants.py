"""How many small changes of the code its tests notice: `python benchmarks/mutants.py ROOM ... --count N`.

Each mutant has one operator, number or condition changed. The tests of its room run on it, those of its file first, and
should fail. Mutants are drawn by seed. What was found is appended to a file, so that a run that was ended goes on.
Mutants that compute the same as the code are listed, with the reason, in `equivalent_mutants.toml`.

A mutant is a fork of a process that has imported PyTorch: a runner that starts Python anew for each, as cosmic-ray
does, takes some seconds more every time.
"""

import argparse
import ast
import copy
import itertools
import json
import os
import random
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")

ROOMS: dict[str, tuple[list[str], list[str]]] = {
    "regression": (["regression/*.py"], ["tests/regression"]),
    "costs": (["costs/*.py"], ["tests/costs"]),
    "metrics": (["metrics/*.py"], ["tests/metrics"]),
    "losses": (["losses/*.py"], ["tests/losses"]),
    "readers": (
        ["data/pfm.py", "data/npy.py", "data/disparity_*.py", "data/images.py", "data/bit_depth.py", "data/inputs.py",
         "data/image_formats/*.py"],
        ["tests/data/test_pfm.py", "tests/data/test_npy.py", "tests/data/test_disparity_files.py",
         "tests/data/test_disparity_png.py", "tests/data/test_images.py", "tests/data/test_inputs.py",
         "tests/data/image_formats"],
    ),
    "calibration": (["calibration/*.py", "calibration/formats/*.py"], ["tests/calibration"]),
    "aggregation": (["aggregation/*.py"], ["tests/aggregation"]),
    "guidance": (["guidance/*.py"], ["tests/guidance"]),
    "upsampling": (["upsampling/*.py"], ["tests/upsampling"]),
    "layers": (["layers/*.py"], ["tests/layers"]),
    "candidates": (["candidates/*.py"], ["tests/candidates"]),
    "backbones": (["backbones/*.py"], ["tests/backbones"]),
    "refinement": (["refinement/*.py"], ["tests/refinement"]),
}  # fmt: skip
"""Files under `stereokit/`, and the tests that should notice; the doctests of a mutated file run too."""

_COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
             ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
             ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
             ast.LShift: ast.RShift, ast.RShift: ast.LShift}  # fmt: skip

MEMORY = 12 * 2**30
"""Addresses that a mutant may use."""

FAILED, COLLECTION_FAILED = 1, 2
"""What pytest ends with where tests fail, and where the changed module can't be imported."""


@dataclass(frozen=True)
class Mutant:
    """A change of one place of a file.

    Attributes:
        file: under the project's folder.
        line: the line of the code, without what it is indented by.
        column: of the change in this line.
        change: before and after.
        number: of the line, from 1.
        place: number of the node, see `_places`.
        way: number of the change, see `_changes`.
    """

    file: str
    line: str
    column: int
    change: str
    number: int
    place: int
    way: int

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What tells it apart, and stays when other lines are edited."""
        return self.file, self.line, self.column, self.change


def main() -> None:
    """Draws mutants, tries them, and prints the score of each room."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rooms", nargs="*", default=list(ROOMS), metavar="ROOM", help=", ".join(ROOMS))
    parser.add_argument("--count", type=int, default=40, help="mutants of each room (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", default="mutants.jsonl", help="what was found so far (default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="try those again that were not noticed before")
    options = parser.parse_args()
    _import_what_never_changes()
    log = Path(options.log)
    noticed: dict[Any, bool] = {}
    for found in map(json.loads, log.read_text().splitlines() if log.exists() else ()):
        noticed[found["file"], found["line"], found["column"], found["change"]] = found["noticed"]
    if options.again:
        noticed = {key: value for key, value in noticed.items() if value}
    equivalent = {
        (m["file"], m["line"], m["change"]): m["why"] for m in tomllib.loads(EQUIVALENT.read_text())["mutant"]
    }
    print("| room | places | tried | equivalent | noticed | score |\n|---|---:|---:|---:|---:|---:|")
    totals = [0, 0, 0, 0]
    for room in options.rooms:
        mutants = [mutant for path in _files(room) for mutant in _mutants(path)]
        drawn = random.Random(f"{options.seed} {room}").sample(mutants, min(options.count, len(mutants)))
        same = [m for m in drawn if (m.file, m.line, m.change) in equivalent]
        counted = [m for m in drawn if m not in same]
        missing = [m for m in counted if m.key not in noticed]
        allowed = _seconds_unchanged(room) if missing else 0.0
        for mutant in missing:
            began = time.monotonic()
            noticed[mutant.key] = _notices(room, mutant, 60 + 10 * allowed)
            found = {**asdict(mutant), "noticed": noticed[mutant.key], "seconds": round(time.monotonic() - began, 1)}
            with log.open("a") as opened:
                opened.write(json.dumps(found) + "\n")
        for mutant in counted:
            if not noticed[mutant.key]:
                print(f"  {mutant.file}:{mutant.number}: {mutant.change}   in: {mutant.line}", flush=True)
        caught = sum(noticed[mutant.key] for mutant in counted)
        row = [len(mutants), len(drawn), len(same), caught]
        totals = [a + b for a, b in zip(totals, row, strict=True)]
        _print_row(room, row)
    _print_row("all", totals)


def _print_row(room: str, row: list[int]) -> None:
    _, tried, same, caught = row
    print(f"| {room} | {' | '.join(map(str, row))} | {100 * caught / max(1, tried - same):.0f} % |", flush=True)


def _files(room: str) -> list[Path]:
    return sorted({path for pattern in ROOMS[room][0] for path in (ROOT / "stereokit").glob(pattern)})


def _import_what_never_changes() -> None:
    import cv2
    import hypothesis.extra.numpy
    import pytest  # noqa: F401
    import timm  # noqa: F401
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    # one failing example is enough, however large it is
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile("mutants", deadline=None, derandomize=True, phases=phases)
    os.environ["STEREOKIT_EXAMPLES"] = "mutants"


def _seconds_unchanged(room: str) -> float:
    """Processor time that the tests of a room take on the code as it is."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    if _notices(room, None, 3600):
        raise SystemExit(f"the tests of {room} fail before anything is changed")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _notices(room: str, mutant: Mutant | None, seconds: float) -> bool:
    """Whether the tests of a room fail, or take more processor time than they may."""
    child = os.fork()
    if child == 0:
        os.setsid()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        # of the processor, since the machine may be busy
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        try:
            code = _run_tests(room, mutant)
        except BaseException:
            code = FAILED
        os._exit(code)
    deadline = time.monotonic() + 20 * seconds
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
        if time.monotonic() > deadline:
            # what waits for something takes no processor time
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.05)
    if os.WIFSIGNALED(ended[1]):
        return True
    code = os.WEXITSTATUS(ended[1])
    if code not in (0, FAILED, COLLECTION_FAILED):
        raise SystemExit(f"pytest ended with {code} on the tests of {room}, {mutant}")
    return code != 0


def _run_tests(room: str, mutant: Mutant | None) -> int:
    import pytest

    sys.path.insert(0, str(ROOT))
    os.chdir(ROOT)
    tests = ROOMS[room][1]
    if mutant is not None:
        sys.meta_path.insert(0, _Mutated(mutant.file, _changed(mutant)))
        own = [path for part in tests for path in ROOT.glob(f"{part}/test_{Path(mutant.file).stem}.py")]
        tests = [*(str(path.relative_to(ROOT)) for path in own), mutant.file, *tests]
    else:
        tests = [*tests, *(str(path.relative_to(ROOT)) for path in _files(room))]
    # plain, since pytest imports what it rewrites by itself, unchanged
    options = ["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist", "--capture=sys"]
    return int(pytest.main([*options, *tests]))


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


def _mutants(path: Path) -> Iterator[Mutant]:
    """The mutants of a file, in the order of its code."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for place, node in enumerate(_places(ast.parse(text))):
        for way in range(len(_changes(node))):
            line, twin = lines[node.lineno - 1], copy.deepcopy(node)
            _changes(twin)[way]()
            yield Mutant(
                file=str(path.relative_to(ROOT)),
                line=line.strip(),
                column=node.col_offset - (len(line) - len(line.lstrip())),
                change=f"{_words(node)} -> {_words(twin)}",
                number=node.lineno,
                place=place,
                way=way,
            )


def _changed(mutant: Mutant) -> ast.Module:
    """The module with the change."""
    tree = ast.parse((ROOT / mutant.file).read_text(encoding="utf-8"))
    node = next(itertools.islice(_places(tree), mutant.place, None))
    _changes(node)[mutant.way]()
    return ast.fix_missing_locations(tree)


def _words(node: ast.AST) -> str:
    """A node, but of a statement with a body its condition alone."""
    return ast.unparse(node.test if isinstance(node, ast.If | ast.While | ast.IfExp) else node)


def _places(tree: ast.AST) -> Iterator[Any]:
    """Every node that can be changed, in one fixed order."""
    for name, field in ast.iter_fields(tree):
        # annotations and decorators are not what a module computes
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in field if isinstance(field, list) else [field]:
            if isinstance(child, ast.AST) and not _is_text(child):
                if _changes(child):
                    yield child
                yield from _places(child)


def _is_text(node: ast.AST) -> bool:
    """Messages, imports, and lists of names."""
    if isinstance(node, ast.Assign):
        return getattr(node.targets[0], "id", "") == "__all__"
    if isinstance(node, ast.If):
        return getattr(node.test, "id", "") == "TYPE_CHECKING"
    return isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom)


def _changes(node: Any) -> list[Callable[[], None]]:
    """What changes a node in place, in one way each."""

    def put(name: str, value: Any) -> Callable[[], None]:
        return lambda: setattr(node, name, value)

    if isinstance(node, ast.Compare):
        ways = [
            [_COMPARED.get(type(o), type(o))() if j == i else o for j, o in enumerate(node.ops)]
            for i in range(len(node.ops))
        ]
        return [put("ops", operators) for operators in ways]
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _COMPUTED:
        return [put("op", _COMPUTED[type(node.op)]())]
    if isinstance(node, ast.BoolOp):
        return [put("op", ast.Or() if isinstance(node.op, ast.And) else ast.And())]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        # twice is not at all
        return [put("operand", ast.UnaryOp(type(node.op)(), node.operand))]
    if isinstance(node, ast.If | ast.IfExp | ast.While) and not isinstance(node.test, ast.Compare | ast.UnaryOp):
        return [put("test", ast.UnaryOp(ast.Not(), node.test))]
    if isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        changed = not node.value if isinstance(node.value, bool) else node.value + 1
        return [put("value", changed)] if changed != node.value else []
    return []


if __name__ == "__main__":
    main()
