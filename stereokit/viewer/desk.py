"""What lies on the desk: the source, the shots made of it lately, and what is found out about them on request."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from stereokit._version import __version__
from stereokit.calibration import Calibration
from stereokit.cameras.consistency import occluded, right_disparity
from stereokit.data.images import to_uint8
from stereokit.errors import ConfigError, InputError
from stereokit.inference import Distributions, PixelDistributions, Predictor
from stereokit.pictures.colors import color_table
from stereokit.viewer.shot import Shot
from stereokit.viewer.sources import Album, Frames, Views

__all__ = ["Desk", "Gone"]

KEPT = 6
"""Shots that stay in memory, so that going back and forth costs nothing."""

DISPARITY_ERROR = 0.5
"""px: what the page takes for the standard error of disparity until told otherwise."""

T = TypeVar("T")


class Gone(InputError):
    """A shot that is not kept any more."""


class Desk:
    """The pairs of a source, matched on request, from any number of threads.

    All matching is done by one thread, because PyTorch keeps a pool of threads for each thread that calls it.

    Args:
        source: pairs in any order, or frames one after the other.
        predictor: matches them; None where the source has results.
        calibration: of all pairs; without it there are no metres. A predictor with a rig has its own.
        disparity_error: the standard error of disparity in px, from which that of depth follows.

    Raises:
        ConfigError: no predictor for a source without results.
        InputError: an error of disparity that is not positive.
    """

    def __init__(
        self,
        source: Album | Frames,
        predictor: Predictor | None = None,
        calibration: Calibration | None = None,
        disparity_error: float = DISPARITY_ERROR,
    ) -> None:
        if predictor is None and not (isinstance(source, Album) and source.results is not None):
            raise ConfigError("pairs without a saved result need a predictor")
        if not 0 < disparity_error < np.inf:
            raise InputError(f"the standard error of disparity must be a positive number of px, got {disparity_error}")
        self.source = source
        self.predictor = predictor
        self.calibration = calibration
        if predictor is not None and predictor.rectification is not None:
            self.calibration = predictor.rectification.calibration
        self.disparity_error = disparity_error
        self.closed = False
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="matching")
        self._source_lock = threading.Lock()
        self._lock = threading.Lock()
        self._shots: OrderedDict[int, Shot] = OrderedDict()
        self._entries: dict[int, int] = {}
        self._found: OrderedDict[tuple[str, int], Any] = OrderedDict()
        self._made = 0
        self._newest: Shot | None = None

    def facts(self) -> dict[str, Any]:
        """What the page has to know at the start, in plain JSON."""
        album = self.source if isinstance(self.source, Album) else None
        return {
            "version": __version__,
            "network": self._network(),
            "entries": None if album is None else album.names,
            "stream": None if isinstance(self.source, Album) else {"name": self.source.name, "live": self.source.live},
            "calibration": None if self.calibration is None else self.calibration.to_dict(),
            "disparity_error": self.disparity_error,
            "matching": self.predictor is not None,
            "colors": {name: color_table(name).tobytes().hex() for name in ("turbo", "viridis")},
        }

    def entry(self, index: int) -> Shot:
        """A pair of an album, matched.

        Raises:
            InputError: there is no such entry, or its images or its result can't be used.
        """
        if not isinstance(self.source, Album):
            raise InputError("this is a stream of frames; ask for the next one")
        if not 0 <= index < len(self.source.pairs):
            raise InputError(f"there is no entry {index}; expected 0 to {len(self.source.pairs) - 1}")
        with self._source_lock:
            try:
                return self.shot(self._entries.get(index, -1))
            except Gone:
                shot = self._match(self.source.open(index))
                self._entries[index] = shot.number
                return shot

    def next(self, after: int) -> Shot | None:
        """The newest frame; one that is matched now, if the newest is the one that the caller has. None at the end.

        Args:
            after: the number of the shot that the caller has, -1 for none.

        Raises:
            InputError: the source breaks off.
        """
        if not isinstance(self.source, Frames):
            raise InputError("this is an album; ask for an entry")
        with self._source_lock:
            if self._newest is not None and self._newest.number > after:
                return self._newest
            views = self.source.next()
            if views is None:
                return None
            self._newest = self._match(views)
            return self._newest

    def shot(self, number: int) -> Shot:
        """A shot that was made lately.

        Raises:
            Gone: it is not kept any more.
        """
        with self._lock:
            if number not in self._shots:
                raise Gone(f"frame {number} is not kept any more; ask for a newer one")
            self._shots.move_to_end(number)
            return self._shots[number]

    def occluded(self, number: int) -> npt.NDArray[np.bool_]:
        """What the right camera does not see, (H, W): the right view is matched too.

        Raises:
            Gone: the shot is not kept any more.
            ConfigError: there is no network.
        """
        predictor = self._needed("occlusion needs the right view's disparity")

        def match(left: Any, right: Any) -> Any:
            return predictor.match(left, right).disparity

        def find(shot: Shot) -> npt.NDArray[np.bool_]:
            return occluded(shot.result.disparity, right_disparity(match, shot.left, shot.right))

        return self._find("occluded", number, find)

    def distributions(self, number: int) -> Distributions:
        """What the network says about all candidates of a shot.

        Raises:
            Gone: the shot is not kept any more.
            ConfigError: there is no network, or it has none.
        """
        predictor = self._needed("a distribution needs a network")
        return self._find("distributions", number, lambda shot: predictor.distributions(shot.left, shot.right))

    def distribution(self, number: int, x: int, y: int) -> PixelDistributions:
        """At one pixel, see `distributions`.

        Raises:
            InputError: a pixel outside of the image.
        """
        found = self.distributions(number)
        return self._worker.submit(found.at, [y], [x]).result()

    def close(self) -> None:
        """Finishes what is being matched, and drops the rest; the source gives no more frames."""
        self.closed = True
        # a live source that stalls gives up by itself, by then
        self._source_lock.acquire(timeout=15)
        # a thread that outlives the program's end takes PyTorch's threads down with it
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _network(self) -> str | None:
        if self.predictor is None:
            return None
        described = self.predictor.backend.describe()
        configuration = described.get("configuration") or {}
        name = configuration.get("name") or described.get("class", "").rpartition(".")[2]
        return f"{name or 'network'} on {self.predictor.device}"

    def _needed(self, why: str) -> Predictor:
        if self.predictor is None:
            raise ConfigError(f"{why}, and this is a saved result; view the pair without --disparity")
        return self.predictor

    def _match(self, views: Views) -> Shot:
        left, right, result = views.left, views.right, views.result
        if self.predictor is not None and self.predictor.rectification is not None:
            first, second = self.predictor.rectified(left, right)
            left, right = (to_uint8(view[0].permute(1, 2, 0).numpy()) for view in (first, second))
        if self.calibration is not None:
            self.calibration.check_size(*left.shape[:2])
        if result is None:
            predictor = self._needed("matching needs a network")
            result = self._worker.submit(predictor.match, left, right).result()
            if predictor.rectification is not None:
                result = result.masked(predictor.rectification.seen(result.disparity))
        lossless = isinstance(self.source, Album)
        with self._lock:
            self._made += 1
            shot = Shot(self._made, views.name, left, right, result, lossless)
            self._shots[shot.number] = shot
            while len(self._shots) > KEPT:
                self._shots.popitem(last=False)
        return shot

    def _find(self, what: str, number: int, find: Callable[[Shot], T]) -> T:
        shot = self.shot(number)

        def once() -> T:
            key = (what, number)
            if key not in self._found:
                self._found[key] = find(shot)
                # distributions are large
                while len(self._found) > 4:
                    self._found.popitem(last=False)
            self._found.move_to_end(key)
            return self._found[key]

        return self._worker.submit(once).result()
