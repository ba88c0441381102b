"""Write a file completely or not at all, and never over somebody else's."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from fkgen.errors import DataError, OutputError

PICTURES = (".png", ".pdf", ".svg")  # what can be drawn, by the ending of the name
_EVERY = 5.0  # seconds between two notes of how much of a file is there


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


class Kept:
    """What there is of a file that is kept when its writing stops.

    Attributes
    ----------
    samples : int
        Those that are in it.
    """

    def __init__(self, path: Path, facts: Mapping[str, Any]) -> None:
        self._path, self._facts = path.with_name(f"{path.name}.partial"), dict(facts)
        self._note = self._path.with_name(f"{self._path.name}.json")
        self.samples, size, self._noted = 0, 0, time.monotonic()
        if self._note.exists():
            self.samples, size = self._read()
        self.file: IO[bytes] = self._path.open("r+b" if self.samples else "wb")
        self.file.truncate(size)
        self.file.seek(size)

    def _read(self) -> tuple[int, int]:
        try:
            found = json.loads(self._note.read_bytes())
            samples, size = int(found["samples"]), int(found["bytes"])
            same = found["facts"] == self._facts and self._path.stat().st_size >= size
        except (OSError, ValueError, KeyError, TypeError):
            same = False
        if not same:
            given = "what is left of another run, or of another record; it stays as it is"
            expected = f"the same call that left it, or its removal, with {self._path.name}"
            raise DataError(str(self._note), given=given, expected=expected)
        return samples, size

    def add(self, data: bytes, samples: int) -> None:
        """Write samples, and note now and then how many there are."""
        self.file.write(data)
        self.samples += samples
        if time.monotonic() - self._noted > _EVERY:
            self.note()

    def note(self) -> None:
        """Note how much is there, once it is."""
        self.file.flush()
        os.fsync(self.file.fileno())
        state = {"facts": self._facts, "samples": self.samples, "bytes": self.file.tell()}
        write_whole(self._note, json.dumps(state).encode(), force=True)
        self._noted = time.monotonic()

    def discard(self) -> None:
        """Leave nothing."""
        self._path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)

    def settle(self, target: Path, *, force: bool) -> None:
        """Give the whole file its name."""
        self.note()
        self.file.close()
        _settle(self._path, target.resolve(), force=force)
        self.discard()


@contextmanager
def kept_whole(path: Path, facts: Mapping[str, Any], *, force: bool) -> Iterator[Kept]:
    """A file as of `written_whole`; what there is of it stays when writing stops, to go on from.

    ``facts`` say what it is about: it goes on only if they are the same.
    """
    refuse_existing(path, force=force)
    try:
        kept = Kept(path, facts)
        try:
            yield kept
            kept.settle(path, force=force)
        except KeyboardInterrupt:
            kept.note()
            there = f"{path}.partial holds {kept.samples} samples"
            raise KeyboardInterrupt(
                f"interrupted; {there}: the same call goes on from there"
            ) from None
        except DataError:  # of the record: it would be the same again
            kept.discard()
            raise
        finally:
            kept.file.close()
    except OSError as error:
        given = (error.strerror or str(error)).lower()
        expected = "a place that can be written; the same call goes on from what is there"
        raise OutputError(str(path), given=given, expected=expected) from None
