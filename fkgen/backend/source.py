"""The generated files as one value, and the one way to put them on disk."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fkgen.backend.ir import CProgram
from fkgen.errors import OutputError

MANIFEST = "manifest.json"


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
    claims : tuple of str
        What was proved about the filter.
    """

    program: CProgram
    files: Mapping[str, str]
    record: str
    claims: tuple[str, ...]

    def write(self, directory: str | os.PathLike[str]) -> Path:
        """Write all files into ``directory``, completely or not at all.

        Parameters
        ----------
        directory : path
            Created if missing. If it exists it has to be empty, or hold nothing but unchanged
            output of an earlier call, which is replaced, or files that are what is to be written
            (the elementary functions that filters share).

        Raises
        ------
        OutputError
            If the folder holds other or edited files, or cannot be written.
        """
        target = Path(directory)
        _refuse_foreign(target, self.files)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            prefix = f".{target.name}-"
            with tempfile.TemporaryDirectory(
                prefix=prefix, dir=target.parent, ignore_cleanup_errors=True
            ) as folder:
                new, old = Path(folder, f"{prefix}new"), Path(folder, f"{prefix}old")
                new.mkdir()
                new.chmod(0o755)
                for name, text in self.files.items():
                    (new / name).write_text(text, encoding="utf-8", newline="\n")
                _swap(new, target, old)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            expected = "a folder that can be written"
            raise OutputError(str(target), given=reason, expected=expected) from None
        return target


def _refuse_foreign(target: Path, files: Mapping[str, str]) -> None:
    """Refuse a folder with files of others; one that would be written just so does no harm."""
    if not target.exists():
        return
    if not target.is_dir():
        raise OutputError(str(target), given="a file", expected="a folder, or nothing yet")
    present, known = {entry.name for entry in target.iterdir()}, _own_files(target)
    same = {
        name
        for name in (present & files.keys()) - known.keys()
        if (target / name).read_bytes() == files[name].encode()
    }
    foreign = sorted(present - known.keys() - same)
    if foreign:
        raise OutputError(
            str(target),
            given=f"a folder with other files ({', '.join(foreign[:3])})",
            expected="an empty or new folder; choose another one",
        )
    for name, digest in known.items():
        if name in present and digest and _digest((target / name).read_bytes()) != digest:
            raise OutputError(
                str(target / name),
                given="a generated file that was edited",
                expected="unchanged files; move the edited one away first",
            )


def _own_files(target: Path) -> dict[str, str]:
    """File names and digests of an earlier output; empty if there was none."""
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
        return {**manifest["files"], MANIFEST: ""} if manifest["generator"] == "fkgen" else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _swap(new: Path, target: Path, old: Path) -> None:
    """Put a folder into the place of another, which comes back if that fails."""
    if target.exists():
        target.rename(old)
    try:
        new.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def with_manifest(files: Mapping[str, str], facts: Mapping[str, object]) -> dict[str, str]:
    """Add ``manifest.json``: facts about the filter, and a digest per file."""
    digests = {name: _digest(text.encode()) for name, text in sorted(files.items())}
    manifest = {"generator": "fkgen", **facts, "files": digests}
    return {**files, MANIFEST: json.dumps(manifest, indent=2) + "\n"}
