"""Content-addressed folders of compiled filters: complete or absent, shared by all builds."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from fkgen.errors import OutputError
from fkgen.version import __version__

LIBRARY = "filter.so"
LAYOUT = "layout.json"
SPEC = "spec.json"  # what was built: for smoothers, and to explain refusals by its equations

#: Lines of /proc/cpuinfo that decide about instructions, on x86 and on ARM.
_TELLING = frozenset(("model name", "flags", "Features", "CPU implementer", "CPU part"))

#: Age in seconds at which an unfinished build is nobody's any more.
ABANDONED = 86400.0


def folder() -> Path:
    """``FKGEN_CACHE``, else fkgen's folder in the user's cache directory."""
    chosen = os.environ.get("FKGEN_CACHE")
    if chosen:
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "fkgen"


@cache
def own_digest() -> str:
    """Digest of fkgen's own code and templates: whatever changes here makes every entry stale."""
    package = Path(__file__).resolve().parents[1]
    roots = [package, package.parent / "templates"]
    digest = hashlib.sha256()
    for root in roots:
        for path in sorted([*root.rglob("*.py"), *root.rglob("*.j2")]):
            digest.update(f"{path.relative_to(root)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def identity() -> str:
    """Version of fkgen, and of its code: where both are the same, so are all digits."""
    return f"{__version__} {own_digest()[:12]}"


@cache
def processor() -> str:
    """What the processor is and can do, as far as the system tells; empty if it does not.

    Compiled code is for processors of one kind, and a home directory may be shared by several.
    """
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    first, *_ = text.split("\n\n")
    told = (line.partition(":") for line in first.splitlines())
    return "; ".join(what.strip() for name, _, what in told if name.strip() in _TELLING)


def key_of(*parts: str) -> str:
    """A name for content."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(f"{len(part)}\n{part}".encode())
    return digest.hexdigest()[:40]


def find(key: str) -> Path | None:
    """The folder of a finished build, if there is one."""
    entry = folder() / key
    return entry if (entry / LIBRARY).is_file() and (entry / LAYOUT).is_file() else None


def store(key: str, fill: Callable[[Path], None]) -> Path:
    """Let ``fill`` make the entry in a folder of its own, then move it into place in one step."""
    target = folder() / key
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target.parent)
        partial = Path(tempfile.mkdtemp(prefix=".building-", dir=target.parent))
        try:
            fill(partial)
            _move(partial, target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        expected = "a folder that can be written; set FKGEN_CACHE to another one"
        given = (error.strerror or str(error)).lower()
        raise OutputError(str(folder()), given=given, expected=expected) from None
    return target


def _move(partial: Path, target: Path) -> None:
    try:
        partial.rename(target)
    except OSError:
        if find(target.name) is None:  # else somebody finished the same build first
            shutil.rmtree(target, ignore_errors=True)
            partial.rename(target)


def _sweep(parent: Path) -> None:
    """Remove what builds left behind that were killed long ago."""
    for left in parent.glob(".building-*"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > ABANDONED:
                shutil.rmtree(left, ignore_errors=True)
