"""The generated files as one value, and the one way to put them on disk.

A folder may hold several filters and files of others. Its manifest says which files are fkgen's:
the facts and digests of one filter, or a list of them under ``filters``.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from fkgen.backend.ir import CProgram
from fkgen.backend.lines import filled
from fkgen.errors import OutputError, of_type

MANIFEST, BUILD = "manifest.json", "CMakeLists.txt"

#: States from which on build files choose the level on small processors.
LARGE_STATES = 6

#: Beginning of the names of files that hold functions for all filters of a program.
SHARED = "fkgen_elementary_"

#: What a manifest says of one filter.
Entry = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Source:
    """Generated C of one filter, in memory.

    Attributes
    ----------
    program : CProgram
        What was printed.
    files : mapping of str to str
        Text by file name: header, source, self-test, build file, manifest.
    record : str
        C that runs a record, compiled for Python only.
    lanes : str
        C that runs several records at once in the lanes of vectors, likewise; empty if too large.
    claims : tuple of str
        What was proved about the filter.
    """

    program: CProgram
    files: Mapping[str, str]
    record: str
    lanes: str
    claims: tuple[str, ...]

    def write(self, directory: str | os.PathLike[str]) -> Path:
        """Write all files into ``directory``, completely or not at all.

        Parameters
        ----------
        directory : path
            Created if missing. Unchanged output of an earlier call for a filter of this name is
            replaced; other filters and files of others stay as they are. A ``CMakeLists.txt`` of
            others stays too, otherwise it builds all filters of the folder.

        Raises
        ------
        OutputError
            If a generated file was edited, if a file of others has the name of one that would be
            written, or if the folder cannot be written.
        """
        of_type("directory", directory, (str, os.PathLike), "the path of a folder")
        target = Path(directory)
        with _writing(target):
            _exchange(target, *_planned(target, self.files))
        return target


def write_package(target: Path, files: Mapping[str, str], facts: Mapping[str, Any]) -> None:
    """Write files of one package, in folders too, completely or not at all.

    Raises
    ------
    OutputError
        If a file was edited, if there is one of others, or if the folder cannot be written.
    """
    known: dict[str, str] = {}
    with _writing(target):
        if (target / MANIFEST).exists():
            try:
                known = dict(json.loads((target / MANIFEST).read_text(encoding="utf-8"))["package"])
            except (ValueError, KeyError, TypeError):
                raise _taken(target / MANIFEST) from None
        _refuse_edited(target, {k: d for k, d in known.items() if ".." not in Path(k).parts})
        _refuse_taken(target, files, {*known}, ())
        digests = {name: _digest(text) for name, text in sorted(files.items())}
        manifest = json.dumps({**facts, "package": digests}, indent=2) + "\n"
        _exchange(target, {**files, MANIFEST: manifest}, known.keys() - files.keys())


@contextmanager
def _writing(target: Path) -> Iterator[None]:
    """Say in one line why a folder cannot be written."""
    try:
        if target.exists() and not target.is_dir():
            raise OutputError(str(target), given="a file", expected="a folder, or nothing yet")
        yield
    except ValueError:
        given = "a path with a null character"
        raise OutputError(repr(str(target)), given=given, expected="a path") from None
    except OSError as error:
        reason, expected = (error.strerror or str(error)).lower(), "a folder that can be written"
        raise OutputError(str(target), given=reason, expected=expected) from None


@contextmanager
def _scratch(target: Path) -> Iterator[Path]:
    """A folder for a while inside another, which is made; and goes if it is new and that fails."""
    new = not target.exists()
    target.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(
            prefix=".fkgen-", dir=target, ignore_cleanup_errors=True
        ) as folder:
            yield Path(folder)
    except BaseException:
        if new:
            with suppress(OSError):
                target.rmdir()
        raise


def _planned(target: Path, files: Mapping[str, str]) -> tuple[dict[str, str], set[str]]:
    """What to write into a folder, by name, and which files of earlier output are to go."""
    entry = json.loads(files[MANIFEST])
    entries, build = _found(target)
    before = entries.pop(entry["name"], {"files": {}})["files"]
    entries = {k: each for k, each in entries.items() if (target / f"{k}.c").exists()}
    others = {name: d for each in entries.values() for name, d in each["files"].items()}
    texts = {name: text for name, text in files.items() if name not in {MANIFEST, BUILD}}
    _refuse_edited(target, before | others | build)
    _refuse_taken(target, texts, before, others)
    entry["files"] = {name: _digest(text) for name, text in texts.items()}
    for each in entries.values():  # what filters share is written anew for all of them
        each["files"] |= {name: _digest(texts[name]) for name in each["files"] if name in texts}
    foreign = BUILD not in build and (target / BUILD).exists()
    texts |= _summary([*entries.values(), entry], build_file=not foreign)
    return texts, before.keys() - others.keys() - texts.keys()


def own_files(target: Path) -> frozenset[str]:
    """Names of the files of a folder that fkgen wrote."""
    entries, build = _found(target)
    return frozenset((MANIFEST, *build, *(f for each in entries.values() for f in each["files"])))


def _found(target: Path) -> tuple[dict[str, Entry], dict[str, str]]:
    """What the manifest of a folder says of each filter, and of the build file."""
    if not (target / MANIFEST).exists():
        return {}, {}
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
        if manifest["generator"] == "fkgen":
            listed: list[Entry] = manifest.get("filters", [manifest])
            entries = {each["name"]: each | {"files": _plain(each["files"])} for each in listed}
            return entries, {k: d for k, d in manifest["files"].items() if k == BUILD}
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    raise _taken(target / MANIFEST)


def _plain(files: Mapping[str, str]) -> dict[str, str]:
    """Digests of the files of a filter, by names that do not lead out of the folder."""
    return {k: d for k, d in sorted(files.items()) if k != BUILD and Path(k).name == k}


def _refuse_edited(target: Path, own: Mapping[str, str]) -> None:
    for name, digest in own.items():
        path = target / name
        if path.exists() and _digest(path.read_bytes()) != digest:
            raise OutputError(
                str(path),
                given="a generated file that was edited",
                expected="unchanged files; move the edited one away first",
            )


def _refuse_taken(
    target: Path, texts: Mapping[str, str], before: Iterable[str], others: Iterable[str]
) -> None:
    """Refuse names that files of others or of other filters have; the same bytes do no harm."""
    for name in sorted(texts.keys() - set(before)):
        path = target / name
        if name in others and not name.startswith(SHARED):
            given, expected = "a file of another filter", "another name of one of the two filters"
            raise OutputError(str(path), given=given, expected=expected)
        if name not in others and path.exists() and path.read_bytes() != texts[name].encode():
            raise _taken(path)


def _taken(path: Path) -> OutputError:
    given = "a file that fkgen did not write"
    return OutputError(
        str(path), given=given, expected="a free name; move it away or choose another folder"
    )


def _exchange(target: Path, files: Mapping[str, str], gone: Iterable[str]) -> None:
    """Write files into a folder and take others away; all is as it was if that fails."""
    with _scratch(target) as scratch:
        _exchanged(target, scratch, files, tuple(gone))


def _exchanged(
    target: Path, scratch: Path, files: Mapping[str, str], gone: tuple[str, ...]
) -> None:
    new, old = scratch / "new", scratch / "old"
    folders = sorted({parent for name in (*gone, *files) for parent in Path(name).parents})
    made = [target / folder for folder in folders if not (target / folder).exists()]
    for root, folder in product((new, old), folders):
        (root / folder).mkdir()
    for name, text in files.items():
        (new / name).write_text(text, encoding="utf-8", newline="\n")
    moved: list[tuple[Path, Path]] = []
    try:
        for folder in made:
            folder.mkdir()
        for name in [*gone, *files]:
            if (target / name).exists():
                moved.append((target / name, old / name))
                (target / name).rename(old / name)
        for name in files:
            moved.append((new / name, target / name))
            (new / name).rename(target / name)
    except BaseException:
        _undo(moved, made)
        raise


def _undo(moved: Sequence[tuple[Path, Path]], made: Sequence[Path]) -> None:
    """Move files back, and take folders away."""
    for source, place in reversed(moved):
        if place.exists() and not source.exists():
            place.rename(source)
    for folder in reversed(made):
        with suppress(OSError):
            folder.rmdir()


def _digest(data: str | bytes) -> str:
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def complete(files: Mapping[str, str], facts: Mapping[str, object]) -> dict[str, str]:
    """Add the build file and ``manifest.json``: facts about the filter, and a digest per file."""
    digests = {name: _digest(text) for name, text in files.items()}
    return {**files, **_summary([{**facts, "files": digests}], build_file=True)}


def _summary(entries: list[Entry], *, build_file: bool) -> dict[str, str]:
    """The files that are about all filters of a folder: build file and manifest."""
    named = {each["name"]: each | {"files": _plain(each["files"])} for each in entries}
    filters = [{k: v for k, v in named[name].items() if k != "generator"} for name in sorted(named)]
    units = {each["name"]: [f for f in each["files"] if _is_unit(f, each)] for each in filters}
    fused = [each["name"] for each in filters if "fused" in each]  # they need libm
    large = [each["name"] for each in filters if len(each["states"]) >= LARGE_STATES]
    context: dict[str, object] = {"filters": units, "fused": fused, "large": large}
    build = {BUILD: filled("CMakeLists.txt.j2", context)} if build_file else {}
    digests = {name: _digest(text) for name, text in build.items()}
    several: Entry = {"filters": filters, "files": digests}
    one = filters[0] | {"files": dict(sorted((filters[0]["files"] | digests).items()))}
    manifest = {"generator": "fkgen", **(several if len(filters) > 1 else one)}
    return {**build, MANIFEST: json.dumps(manifest, indent=2) + "\n"}


def _is_unit(file: str, entry: Entry) -> bool:
    """Whether a file is part of the library of a filter."""
    apart = tuple(f"{entry['name']}_{kind}" for kind in ("selftest", "fuzz"))
    return file.endswith(".c") and not file.startswith(apart)
