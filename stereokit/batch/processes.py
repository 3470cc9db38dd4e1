"""Processes that match pairs side by side, each with a network of its own."""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from stereokit.batch.job import BatchJob, MatchedPair
from stereokit.batch.manifest import MadeWith, Records
from stereokit.errors import InputError, StereoKitError
from stereokit.optimize import keep_freed_memory

__all__ = ["Crew"]


class Crew:
    """Processes that share the pairs of a job: each takes the next one when it has room for it.

    Args:
        job: what is done to each pair.
        processes: how many.
        devices: of each in turn; by default each chooses.

    Raises:
        StereoKitError: the network can't be opened.
    """

    def __init__(self, job: BatchJob, processes: int, devices: Sequence[str]) -> None:
        context = multiprocessing.get_context("spawn")
        self._taken, self._stop = context.Value("q", 0), context.Event()
        self._processes: dict[Connection, Any] = {}
        threads = max(1, torch.get_num_threads() // processes)
        for i in range(processes):
            ours, theirs = context.Pipe()
            device = devices[i % len(devices)] if devices else None
            arguments = (theirs, self._taken, self._stop, job, device, threads, i > 0)
            process = context.Process(target=_work, args=arguments, daemon=True)
            process.start()
            theirs.close()
            self._processes[ours] = process
        try:
            described = [self._receive(connection) for connection in self._processes]
            self.made_with: MadeWith = described[0]
        except BaseException:
            self.close()
            raise

    def run(self, staging: Path, tell: Callable[[int, MatchedPair | StereoKitError], None]) -> None:
        """Matches all pairs; tells of them in order.

        Raises:
            InputError: a process ended before its time.
        """
        for connection in self._processes:
            connection.send((staging, self.made_with))
        running = list(self._processes)
        outcomes: dict[int, MatchedPair | StereoKitError] = {}
        turn, lost, interrupted = 0, "", None
        while running:
            try:
                ready = wait(running)
                for connection in [one for one in running if one in ready]:
                    try:
                        message = connection.recv()
                    except EOFError:
                        message = None
                        lost = self._ended(connection)
                        self._stop.set()
                    if message is None:
                        running.remove(connection)
                    else:
                        outcomes[message[0]] = message[1]
                while turn in outcomes:
                    turn += 1
                    tell(turn - 1, outcomes.pop(turn - 1))
            except KeyboardInterrupt as error:
                if interrupted:
                    raise
                # what was begun is finished
                interrupted = error
                self._stop.set()
        for turn in sorted(outcomes):
            # those of a process that was lost are missing between them
            tell(turn, outcomes[turn])
        if interrupted:
            raise interrupted
        if lost:
            raise InputError(f"{lost}; the same command again goes on where it stopped")

    def close(self) -> None:
        """Ends the processes."""
        self._stop.set()
        for connection, process in self._processes.items():
            connection.close()
            process.join(timeout=10)
            if process.is_alive():
                process.kill()
                process.join()

    def _receive(self, connection: Connection) -> MadeWith:
        try:
            message = connection.recv()
        except EOFError:
            raise InputError(self._ended(connection)) from None
        if isinstance(message, StereoKitError):
            raise message
        made_with: MadeWith = message
        return made_with

    def _ended(self, connection: Connection) -> str:
        process = self._processes[connection]
        process.join()
        code = process.exitcode
        reason = f"was killed by signal {-code}" if code < 0 else f"failed with exit code {code}"
        hint = ": most often memory ran out, and fewer --processes need less" if code == -signal.SIGKILL else ""
        return f"one of {len(self._processes)} processes that match pairs {reason}{hint}"


def _work(
    connection: Connection, taken: Any, stop: Any, job: BatchJob, device: str | None, threads: int, quiet: bool
) -> None:
    """The main function of a process."""
    # Ctrl-C reaches all of them; the first one says when to stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(threads)
    keep_freed_memory()
    try:
        # what is said about the network is said once
        with contextlib.redirect_stdout(None) if quiet else contextlib.nullcontext():
            predictor = job.open_predictor(device)
        connection.send(job.made_with(predictor))
    except StereoKitError as error:
        connection.send(error)
        return
    try:
        staging, made_with = connection.recv()
    except EOFError:
        return
    records = Records(job.out)
    # the others have not opened a network for nothing, if one can't go on
    with contextlib.suppress(BrokenPipeError):
        job.run(
            predictor,
            made_with,
            records,
            staging,
            _turns(taken, stop, len(job.pairs)),
            lambda turn, outcome: connection.send((turn, outcome)),
        )
        connection.send(None)


def _turns(taken: Any, stop: Any, count: int) -> Iterator[int]:
    """Numbers that no other process takes."""
    while not stop.is_set():
        with taken.get_lock():
            turn = taken.value
            taken.value += 1
        if turn >= count:
            return
        yield turn
