"""Spec files."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

from fkgen.problem.spec import Spec
from fkgen.problem.table.place import Place


def load(path: str | os.PathLike[str]) -> Spec:
    """Return the spec in a TOML file.

    Parameters
    ----------
    path : str or path
        The file.

    Raises
    ------
    SpecError
        If the file cannot be read, is not UTF-8 or not TOML, or does not hold a spec.
    """
    file = str(path)
    place = Place(file, "file")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise place.error(
            f"bytes that are not UTF-8 at offset {fault.start}", "a UTF-8 text"
        ) from None
    except OSError as fault:
        reason = (fault.strerror or type(fault).__name__).lower()
        raise place.error(f"a path that cannot be read ({reason})", "a readable file") from None
    except ValueError:
        raise place.error("a path with a null character", "a readable file") from None
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise place.error("arrays or tables nested too deeply", "a spec in TOML") from None
    except ValueError as fault:
        last = text.count("\n") + 1
        reason = " ".join(str(fault).split()).replace(
            "at end of document", f"at line {last}, the end of the document"
        )
        raise place.error(f"invalid TOML: {reason}", "a spec in TOML") from None
    return Spec.from_dict(table, file=file)
