"""What commands are given by name: constant inputs or a record, and a profile of faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.study.records.table import Table, read_columns, read_table

Array = NDArray[np.float64]


def numbers_of(option: str, text: str, count: int) -> Array | None:
    """Numbers separated by commas, one per signal; None if the option was left out."""
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        expected = f"{count} finite numbers, separated by commas"
        raise DataError(option, given=repr(text), expected=expected)
    return values


def constants_or_record(
    spec: Spec, inputs: str, record: Path | None
) -> tuple[Array | None, Table | None]:
    """Constant inputs (q,) from ``--u``, or the table of ``--record``, or neither; not both."""
    constants = numbers_of("--u", inputs, spec.model.nu)
    if record is None:
        return constants, None
    if constants is not None:
        raise DataError("--u", given="inputs beside --record", expected="one of the two")
    return None, read_table(record, spec)


def profile_of(spec: Spec, path: Path) -> tuple[Array, Array | None]:
    """What is added to y (T, p) and to u (T, q), from a file that names one signal at least."""
    p = spec.model.ny
    names = [signal.name for signal in (*spec.model.outputs, *spec.model.inputs)]
    both = np.stack(list(read_columns(path, names).values()), axis=1)
    return both[:, :p], both[:, p:] if spec.model.nu else None
