"""Write a file completely or not at all, and never over somebody else's."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from fkgen.errors import OutputError

PICTURES = (".png", ".pdf", ".svg")  # what can be drawn, by the ending of the name


def refuse_targets(output: Path | None, plot: Path | None = None, *, force: bool) -> None:
    """Refuse what a command cannot or must not write, before any work is done for it."""
    for path in filter(None, (output, plot)):
        refuse_existing(path, force=force, hint=", or --force to replace it")
    if plot is not None:
        refuse_format(plot)


def refuse_existing(path: Path, *, force: bool, hint: str = "") -> None:
    """Refuse a folder, a file that exists unless ``force`` is set, and a name in no folder."""
    given = ""
    if path.is_dir():
        given, expected = "a folder", "the name of a file"
    elif path.is_file() and not force:
        given, expected = "a file that exists", f"the name of a new file{hint}"
    elif not path.parent.is_dir():
        given, expected = "a folder that does not exist", "one that does; create it"
    if given:
        raise OutputError(str(path), given=given, expected=expected)


def refuse_format(path: Path) -> None:
    """Refuse the name of a picture that ends in no format that can be drawn."""
    if path.suffix.lower() not in PICTURES:
        given = f"the ending {path.suffix!r}" if path.suffix else "a name without ending"
        expected = f"a picture that ends in {', '.join(PICTURES)}"
        raise OutputError(str(path), given=given, expected=expected)


def write_whole(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` as `written_whole` does."""
    with written_whole(path, force=force) as file:
        file.write(data)


@contextmanager
def written_whole(path: Path, *, force: bool = False) -> Iterator[IO[bytes]]:
    """A file with a name of its own that is moved into place in one step when all is written.

    Whatever fails (no permission, disk full) is an `OutputError`, and nothing is left behind. What
    is no regular file (a pipe, a terminal) is written directly.
    """
    refuse_existing(path, force=force)
    target = path.resolve()
    partial = target.with_name(f".fkgen-{secrets.token_hex(6)}.partial")
    try:
        if path.exists() and not path.is_file():
            with path.open("wb") as file:
                yield file
            return
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # a full disk shows here at the latest
        _settle(partial, target, force=force)
    except OSError as error:
        given = (error.strerror or str(error)).lower()
        expected = "a place that can be written; nothing was left there"
        raise OutputError(str(path), given=given, expected=expected) from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _settle(partial: Path, target: Path, *, force: bool) -> None:
    """Give the finished file its name; a link fails where a file came into being meanwhile."""
    if not force:
        try:
            os.link(partial, target)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            refuse_existing(target, force=False)
        else:
            return
    partial.replace(target)
