"""Write a file completely or not at all, and never over somebody else's."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable
from pathlib import Path

from fkgen.errors import OutputError

#: Formats of pictures, by the ending of the name.
PICTURES = (".png", ".pdf", ".svg")


def refuse_existing(path: Path, *, force: bool, hint: str = "") -> None:
    """Refuse a target that cannot or must not be written, before any work is done for it.

    Parameters
    ----------
    path : Path
        The target.
    force : bool
        It may exist.
    hint : str
        How to allow that, such as ``", or --force"``.

    Raises
    ------
    OutputError
        If it is a folder, or a file and ``force`` is not set, or lies in no folder.
    """
    if path.is_dir():
        raise OutputError(str(path), given="a folder", expected="the name of a file")
    if path.is_file() and not force:
        raise OutputError(
            str(path), given="a file that exists", expected=f"the name of a new file{hint}"
        )
    if not path.parent.is_dir():
        raise OutputError(
            str(path), given="a folder that does not exist", expected="one that does; create it"
        )


def refuse_format(path: Path) -> None:
    """Refuse the name of a picture that ends in no format that can be drawn.

    Raises
    ------
    OutputError
    """
    if path.suffix.lower() not in PICTURES:
        given = f"the ending {path.suffix!r}" if path.suffix else "a name without ending"
        expected = f"a picture that ends in {', '.join(PICTURES)}"
        raise OutputError(str(path), given=given, expected=expected)


def write_whole(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` under a name of its own and move it into place in one step.

    Parameters
    ----------
    path : Path
        The target. What is no regular file (a pipe, a terminal) is written directly.
    data : bytes
        All of it.
    force : bool
        Replace a file that exists.

    Raises
    ------
    OutputError
        If it exists, or cannot be written (no permission, disk full); nothing is left behind then.
    """
    refuse_existing(path, force=force)
    if path.exists() and not path.is_file():
        _attempt(path, lambda: path.write_bytes(data))
        return
    target = path.resolve()
    partial = target.with_name(f".fkgen-{secrets.token_hex(6)}.partial")
    try:
        _attempt(path, lambda: _fill(partial, data))
        _attempt(path, lambda: _settle(partial, target, force=force))
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _fill(partial: Path, data: bytes) -> None:
    with partial.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())  # a full disk shows here at the latest


def _settle(partial: Path, target: Path, *, force: bool) -> None:
    """Give the finished file its name; a link fails where a file came into being meanwhile."""
    if force:
        partial.replace(target)
        return
    try:
        os.link(partial, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        refuse_existing(target, force=False)
        partial.replace(target)


def _attempt(path: Path, action: Callable[[], object]) -> None:
    try:
        action()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(
            str(path), given=reason, expected="a place that can be written; nothing was left there"
        ) from None
