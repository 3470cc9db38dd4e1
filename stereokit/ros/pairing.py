"""Left and right messages of one time."""

from typing import Generic, Literal, TypeVar

__all__ = ["StampPairs"]

T = TypeVar("T")


class StampPairs(Generic[T]):
    """Pairs messages of both sides whose stamps are nearest and not farther apart than a tolerance.

    The stamps of each side must rise. What can find no partner any more is counted.

    Args:
        tolerance: in nanoseconds; below half the time between frames.

    Attributes:
        unpaired: messages of each side that were left alone; `finish` adds those that still wait.

    >>> pairs = StampPairs(tolerance=5)
    >>> pairs.add("left", 0, "a"), pairs.add("right", 3, "b"), pairs.add("left", 30, "c"), pairs.add("right", 60, "d")
    (None, ('a', 'b'), None, None)
    >>> pairs.finish()
    {'left': 1, 'right': 1}
    """

    def __init__(self, tolerance: int) -> None:
        self.tolerance = tolerance
        self.unpaired = {"left": 0, "right": 0}
        self._waiting: dict[str, list[tuple[int, T]]] = {"left": [], "right": []}

    def add(self, side: Literal["left", "right"], stamp: int, message: T) -> tuple[T, T] | None:
        """Takes a message in; gives the pair, left and right, if its partner was waiting."""
        other = "right" if side == "left" else "left"
        waiting = self._waiting[other]
        # later messages of this side are later still
        late = [entry for entry in waiting if entry[0] < stamp - self.tolerance]
        self.unpaired[other] += len(late)
        del waiting[: len(late)]
        near = [entry for entry in waiting if entry[0] <= stamp + self.tolerance]
        if not near:
            self._waiting[side].append((stamp, message))
            return None
        partner = min(near, key=lambda entry: abs(entry[0] - stamp))
        before = waiting.index(partner)
        self.unpaired[other] += before
        del waiting[: before + 1]
        return (message, partner[1]) if side == "left" else (partner[1], message)

    def finish(self) -> dict[str, int]:
        """The end: what still waits stays alone."""
        for side, waiting in self._waiting.items():
            self.unpaired[side] += len(waiting)
            waiting.clear()
        return self.unpaired
