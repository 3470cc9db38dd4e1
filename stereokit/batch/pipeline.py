"""Reading, computing and writing at once, in order and within a bound."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from stereokit.errors import StereoKitError

__all__ = ["read_ahead", "run_pipeline"]

Item = TypeVar("Item")
Read = TypeVar("Read")
Computed = TypeVar("Computed")
Written = TypeVar("Written")

_END = object()


def run_pipeline(
    items: Iterable[Item],
    *,
    read: Callable[[Item], Read],
    compute: Callable[[Item, Read], Computed],
    write: Callable[[Item, Computed], Written],
    tell: Callable[[Item, Written | StereoKitError], None],
    workers: int,
    ahead: int | None = None,
) -> None:
    """Takes each item through three stages, of which the first and the last run in threads beside the second.

    `compute` and `tell` run in the calling thread, in the order of the items. What is computed when the loop ends
    early, as by Ctrl-C, is still written and told.

    Args:
        items: are asked for as they are needed.
        read: item to what `compute` takes.
        compute: to what `write` takes.
        write: to what `tell` is told.
        tell: is told of each item, in order: what `write` gave, or the error that one of the stages raised.
        workers: threads that read, and as many that write; with 0 all is done in the calling thread, one after the
            other.
        ahead: how many items may wait between two stages, `workers + 1` by default: so many are in memory at most,
            twice, beside the one that is computed.

    Raises:
        Exception: what a stage raised that is no `StereoKitError`, and what `tell` raised.

    >>> run_pipeline("ab", read=str.upper, compute=lambda item, x: 2 * x, write=lambda item, x: f"{item}: {x}",
    ...              tell=lambda item, said: print(said), workers=2)
    a: AA
    b: BB
    """
    if workers == 0:
        for item in items:
            tell(item, _outcome(lambda item=item: write(item, compute(item, read(item)))))  # type: ignore[misc]
        return
    ahead = ahead or workers + 1
    with ThreadPoolExecutor(workers) as readers, ThreadPoolExecutor(workers) as writers:
        writing: deque[tuple[Item, Callable[[], Written]]] = deque()

        def tell_first() -> None:
            item, result = writing.popleft()
            tell(item, _outcome(result))

        try:
            for item, result in _reading(readers, read, items, ahead):
                while len(writing) >= ahead:
                    tell_first()
                try:
                    future = writers.submit(write, item, compute(item, result()))
                except StereoKitError as error:
                    future = Future()
                    future.set_exception(error)
                writing.append((item, future.result))
        finally:
            readers.shutdown(wait=False, cancel_futures=True)
            while writing:
                tell_first()


def read_ahead(
    items: Iterable[Item], read: Callable[[Item], Read], *, workers: int, ahead: int | None = None
) -> Iterator[Read]:
    """What `read` gives for each item, in order, read in threads before it is asked for.

    Args:
        items: are asked for as they are needed.
        read: what an item becomes.
        workers: threads; with 0 each item is read when it is asked for.
        ahead: how many are read before they are asked for, at most; `workers + 1` by default.

    Raises:
        Exception: what `read` raised, in the item's turn.

    >>> list(read_ahead([1, 2], lambda number: 2 * number, workers=1))
    [2, 4]
    """
    if workers == 0:
        yield from map(read, items)
        return
    with ThreadPoolExecutor(workers) as readers:
        try:
            for _, result in _reading(readers, read, items, ahead or workers + 1):
                yield result()
        finally:
            readers.shutdown(wait=False, cancel_futures=True)


def _reading(
    readers: ThreadPoolExecutor, read: Callable[[Item], Read], items: Iterable[Item], ahead: int
) -> Iterator[tuple[Item, Callable[[], Read]]]:
    waiting: deque[tuple[Item, Callable[[], Read]]] = deque()
    source = iter(items)
    while True:
        while len(waiting) < ahead and (item := next(source, _END)) is not _END:
            waiting.append((item, readers.submit(read, item).result))  # type: ignore[arg-type]
        if not waiting:
            return
        yield waiting.popleft()


def _outcome(result: Callable[[], Written]) -> Written | StereoKitError:
    try:
        return result()
    except StereoKitError as error:
        return error
