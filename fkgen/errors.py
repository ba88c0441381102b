"""Every exception that fkgen raises on purpose: yours (`UserError`) or ours (`InternalError`).

A user's mistake is always a `UserError`; its text is one line that says where, what was given, what
was expected and, where it helps, how to mend it. The facts are attributes too.
"""

from __future__ import annotations

from typing import Any

#: Characters of what was given that an error shows.
_SHOWN = 120


class FkgenError(Exception):
    """Root of every exception raised on purpose; picklable, to leave a worker process."""

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild from text and attributes, not from constructor arguments."""
        return _rebuilt, (type(self), self.args, self.__dict__)


def _rebuilt(
    kind: type[FkgenError], texts: tuple[object, ...], facts: dict[str, object]
) -> FkgenError:
    error = kind.__new__(kind, *texts)
    error.__dict__.update(facts)
    return error


class UserError(FkgenError):
    """Something outside fkgen has to change: a spec, a record, a folder, a compiler."""


class InternalError(FkgenError):
    """fkgen contradicts itself. Please report it, with the spec that shows it."""


class UnfitError(InternalError):
    """A program cannot run with the numbers that it was given; who knows the spec says it there.

    Attributes
    ----------
    what : str
        What it does with them.
    """

    def __init__(self, name: str, what: str) -> None:
        self.what = what
        super().__init__(f"{name}: {what}")


class SpecError(UserError):
    """A spec says something that cannot be, or does not say what it must.

    Attributes
    ----------
    file : str
        The spec file, or ``"<dict>"``.
    key : str
        Dotted path of the entry, such as ``model.A``.
    given, expected : str
        What stands there and what should.
    """

    def __init__(self, key: str, *, given: str, expected: str, file: str = "<dict>") -> None:
        self.file, self.key, self.given, self.expected = file, key, given, expected
        super().__init__(f"{file}: {key}: given {given}; expected {expected}")


class DataError(UserError):
    """A record (measurements, inputs, times, parameters) cannot be filtered as it stands."""

    def __init__(self, what: str, *, given: str, expected: str) -> None:
        line = " ".join(given.split())
        given = line if len(line) <= _SHOWN else f"{line[:_SHOWN]}..."
        self.what, self.given, self.expected = what, given, expected
        super().__init__(f"{what}: given {given}; expected {expected}")


class OutputError(UserError):
    """Files cannot be written where they were asked for; nothing was left half written."""

    def __init__(self, path: str, *, given: str, expected: str) -> None:
        self.path, self.given, self.expected = path, given, expected
        super().__init__(f"{path}: given {given}; expected {expected}")


class CompilerError(UserError):
    """No C compiler was found, or it refused the generated code."""


class StepRefused(UserError):
    """The compiled filter refused a sample (negative status); its state is unchanged.

    Attributes
    ----------
    status : int
        The negative status of the C function.
    name : str
        Its name in the C enum, such as ``DC_MOTOR_INPUT_NOT_FINITE``.
    reason : str
        Which equation is not finite, and where, if that is the reason; else empty.
    """

    def __init__(self, status: int, name: str, meaning: str, reason: str = "") -> None:
        self.status, self.name, self.reason = status, name, reason
        why = f": {reason}" if reason else ""
        super().__init__(f"step refused with status {status} ({name}): {meaning}{why}")


class ValidationError(InternalError):
    """A recursion contradicts a closed form of its family. It is never lowered to C.

    Attributes
    ----------
    family : str
        The family that was built.
    failed : tuple of str
        The claims that do not hold, each with its error and tolerance.
    """

    def __init__(self, family: str, failed: tuple[str, ...]) -> None:
        self.family, self.failed = family, failed
        super().__init__(f"{family}: not so: " + "; ".join(failed))


def of_type(what: str, value: Any, kind: Any, expected: str) -> Any:
    """Return a value if it is of a type, or of one of several.

    Raises
    ------
    DataError
        If it is not.
    """
    if not isinstance(value, kind):
        raise DataError(what, given=f"a value of type {type(value).__name__}", expected=expected)
    return value


def names_of(what: str, value: Any, expected: str) -> tuple[str, ...]:
    """Return one text, or several, as a tuple.

    Raises
    ------
    DataError
        If it is something else.
    """
    try:
        names = (value,) if isinstance(value, str) else tuple(value)
    except TypeError:
        names = (value,)
    return tuple(of_type(what, name, str, expected) for name in names)
