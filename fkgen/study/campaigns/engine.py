"""Who computes: threads of this process, or workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from threading import Event
from typing import Any

from fkgen.errors import DataError
from fkgen.runtime import cache
from fkgen.runtime.blocks import cores
from fkgen.runtime.record import whole
from fkgen.study.campaigns.block import Work
from fkgen.study.campaigns.sums import Sums

#: ``engine(ranges)`` computes ranges of blocks, and hands each over when it is done.
Engine = Callable[[Iterable[range]], Iterator[tuple[range, Sums]]]

#: Seconds to wait for a scheduler, and for a worker where there is none.
PATIENCE = 30.0
_LOUD = ("distributed.client", "distributed.utils", "distributed.core", "distributed.comm")
_TICK, _PAUSE = 0.5, 2.0  # seconds of a wait, and between looks at whether anybody is there


class Lost(DataError):
    """Whoever computed is gone."""


@contextmanager
def engine_of(work: Work, workers: int | None, scheduler: Any) -> Iterator[tuple[Engine, int]]:
    """What computes ranges of blocks, and how many it computes at a time."""
    if scheduler is None:
        threads = cores() if workers is None else workers
        with _threads(work, threads) as engine:
            yield engine, threads
    else:
        with _cluster(work, scheduler) as found:
            yield found


def check_workers(workers: int | None, scheduler: Any) -> None:
    """Refuse what cannot be asked for together, before anything is built."""
    if workers is not None and scheduler is not None:
        expected = "one of the two: a cluster has workers of its own"
        raise DataError("workers", given="a number beside a scheduler", expected=expected)
    if workers is not None:
        whole("workers", workers, least=1, most=4096, expected="a whole number from 1 to 4096")
    if scheduler is not None:
        _distributed()


@contextmanager
def _threads(work: Work, threads: int) -> Iterator[Engine]:
    """Threads: drawing and filtering happen in C, which lets go of Python's lock."""
    stop = Event()
    with ThreadPoolExecutor(threads, "fkgen-montecarlo") as pool:
        try:
            yield lambda ranges: _finished(
                lambda blocks: pool.submit(work.sums, blocks, stop), ranges, 2 * threads
            )
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _finished(
    submit: Callable[[range], Future[Sums]],
    ranges: Iterable[range],
    most: int,
    look: Callable[[], None] = lambda: None,
) -> Iterator[tuple[range, Sums]]:
    """Ranges as they are finished, of which ``most`` wait at a time."""
    waiting, left = dict[Future[Sums], range](), iter(ranges)
    try:
        while True:
            while len(waiting) < most and (blocks := next(left, None)) is not None:
                waiting[submit(blocks)] = blocks
            if not waiting:
                return
            done, _ = wait(waiting, timeout=_TICK, return_when=FIRST_COMPLETED)
            look()
            for each in done:
                yield waiting.pop(each), each.result()
    finally:
        for each in waiting:
            each.cancel()


def _distributed() -> Any:
    try:
        import distributed  # noqa: PLC0415 - an optional extra
    except ImportError:
        expected = "Dask distributed, which is not installed: pip install 'fkgen[cluster]'"
        raise DataError("scheduler", given="a cluster", expected=expected) from None
    return distributed


@contextmanager
def _cluster(work: Work, scheduler: Any) -> Iterator[tuple[Engine, int]]:
    """Workers of a Dask cluster: tasks of a worker that dies are done again by another one."""
    distributed = _distributed()
    client, own = _client(distributed, scheduler)
    loggers = [logging.getLogger(name) for name in _LOUD]
    levels = [each.level for each in loggers]
    for each in loggers:
        each.setLevel(logging.CRITICAL)  # what goes wrong is told in one line
    try:
        # a task of its own: whoever loses it gets it again
        shared = client.submit(_itself, work, pure=False)
        pool = client.get_executor(pure=False)
        threads = max(1, sum(client.nthreads().values()))

        def engine(ranges: Iterable[range]) -> Iterator[tuple[range, Sums]]:
            def submit(blocks: range) -> Future[Sums]:
                found: Future[Sums] = pool.submit(_remote, shared, blocks, cache.identity())
                return found

            try:
                yield from _finished(submit, ranges, 4 * threads, _watch(client))
            except (distributed.KilledWorker, CancelledError, OSError) as error:
                raise _lost(error) from None

        yield engine, threads
    finally:
        if own:
            with contextlib.suppress(Exception):  # it may be gone
                client.close(timeout=2)
        for each, level in zip(loggers, levels, strict=True):
            each.setLevel(level)


def _client(distributed: Any, scheduler: Any) -> tuple[Any, bool]:
    """A client of a scheduler, and whether it is ours to close."""
    if isinstance(scheduler, distributed.Client):
        return scheduler, False
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError, TimeoutError) as error:
        given = f"{scheduler!r}, where none answers ({type(error).__name__})"
        expected = "the address of a running Dask scheduler, such as tcp://10.0.0.1:8786"
        raise DataError("scheduler", given=given, expected=expected) from None
    return client, True


def _watch(client: Any) -> Callable[[], None]:
    """What raises where no scheduler or no worker has been there for a while."""
    last = asked = time.monotonic()

    def look() -> None:
        nonlocal last, asked
        if time.monotonic() - asked < _PAUSE:
            return
        asked = time.monotonic()
        if client.status == "running" and client.scheduler_info(n_workers=-1).get("workers"):
            last = time.monotonic()
        elif client.status in {"closed", "closing"} or time.monotonic() - last > PATIENCE:
            raise _lost(None)

    return look


def _lost(error: BaseException | None) -> Lost:
    why = "" if error is None else f" ({type(error).__name__})"
    return Lost("scheduler", given=f"a cluster that is gone{why}", expected="one that stays")


def _itself(work: Work) -> Work:
    """The work, compiled where it arrives."""
    return work


def _remote(work: Work, blocks: range, identity: str) -> Sums:
    """A task: a worker with another fkgen would have other digits."""
    if identity != cache.identity():
        given = f"a worker with fkgen {cache.identity()}"
        raise DataError("scheduler", given=given, expected=f"fkgen {identity} on every worker")
    return work.sums(blocks)
