"""Independent pieces of work on all cores, in blocks: compiled code lets go of Python's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from contextvars import ContextVar

from fkgen.console import Advance
from fkgen.errors import of_type

_ALONE: ContextVar[bool] = ContextVar("alone", default=False)


@contextmanager
def one_thread() -> Iterator[None]:
    """Whatever is done in blocks here is done by this thread: others have work of their own."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_blocks(
    work: Callable[[int, int], object], total: int, size: int, advance: Advance | None = None
) -> None:
    """Call ``work(start, stop)`` for blocks of ``size`` pieces out of ``total``, in threads."""
    if advance is not None:
        of_type("advance", advance, Callable, "a function of one number, or None")
    blocks = [(start, min(start + size, total)) for start in range(0, total, size)]
    if len(blocks) == 1 or _ALONE.get():
        for start, stop in blocks:
            work(start, stop)
            if advance is not None:
                advance(stop - start)
        return
    with ThreadPoolExecutor(max(1, min(cores(), len(blocks)))) as pool:
        waiting = {pool.submit(work, *block): block for block in blocks}
        try:
            for done in as_completed(waiting):
                done.result()
                start, stop = waiting[done]
                if advance is not None:
                    advance(stop - start)
        finally:  # an error or an interruption: what has not begun is not begun
            pool.shutdown(wait=False, cancel_futures=True)
