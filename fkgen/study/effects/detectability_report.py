"""The table of least biases, row by row of y: what ``fkgen detectability`` does."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from fkgen.errors import DataError
from fkgen.spec import Spec
from fkgen.study.effects.detectability import Detectability, detectability
from fkgen.study.effects.effect_report import numbers_of
from fkgen.study.jsonable import finite_or_none


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """The options of the command, under their names; see its help."""

    direction: str = ""
    false_alarm: float = 1e-3
    power: float = 0.9
    window: str = "1,10,50,200"
    inputs: str = ""


@dataclass(frozen=True, eq=False)
class Answer:
    """Least biases by sensor (or direction) and window."""

    wish: Wish
    windows: tuple[int, ...]
    found: tuple[tuple[str, str, tuple[Detectability, ...]], ...]

    def table(self) -> tuple[Sequence[str], list[Sequence[str]]]:
        """One row per sensor: first NIS, then each window by sum of NIS and by GLR."""
        wide = [f"{test} {w}" for test in ("NIS sum", "GLR") for w in self.windows]
        rows: list[Sequence[str]] = []
        for name, unit, each in self.found:
            sums = [f"{one.windowed_nis:.4g}" for one in each]
            ratios = [f"{one.glr:.4g}" for one in each]
            rows.append((name, unit, f"{each[0].nis:.4g}", *sums, *ratios))
        return ("bias of", "unit", "NIS 1", *wide), rows

    def sentence(self) -> str:
        """What the numbers mean."""
        return (
            f"Least constant bias found with probability {self.wish.power:g} at "
            f"{self.wish.false_alarm:g} false alarms per test, from its onset on, filter at rest."
        )

    def to_json(self) -> str:
        """All of it; what is infinite becomes null."""
        rows = [
            {
                "name": name,
                "unit": unit,
                "direction": each[0].direction.tolist(),
                "nis": finite_or_none(each[0].nis),
                "windowed_nis": finite_or_none([one.windowed_nis for one in each]),
                "glr": finite_or_none([one.glr for one in each]),
                "onset_noncentrality": float(each[0].information[0]),
                "plateau_noncentrality": each[0].plateau,
            }
            for name, unit, each in self.found
        ]
        facts = {
            "false_alarm": self.wish.false_alarm,
            "power": self.wish.power,
            "windows": list(self.windows),
        }
        return json.dumps(facts | {"biases": rows}, indent=2)


def answer(spec: Spec, wish: Wish) -> Answer:
    """Ask for every row of y, or for one direction.

    Raises
    ------
    DataError
        If an option does not fit, or the family has no answer.
    """
    windows = _windows(wish.window)
    u = numbers_of("--u", wish.inputs, spec.model.nu)
    along = numbers_of("--direction", wish.direction, spec.model.ny)
    asked = [(signal.name, signal.unit, signal.name) for signal in spec.model.outputs]
    directions = asked if along is None else [(wish.direction, "", along)]
    found = tuple(
        (
            name,
            unit,
            tuple(detectability(spec, each, wish.false_alarm, wish.power, w, u=u) for w in windows),
        )
        for name, unit, each in directions
    )
    return Answer(wish, windows, found)


def _windows(text: str) -> tuple[int, ...]:
    try:
        windows = tuple(int(part) for part in text.split(","))
    except ValueError:
        windows = ()
    if not windows or min(windows) < 1:
        expected = "numbers of samples, at least 1, separated by commas"
        raise DataError("--window", given=repr(text), expected=expected)
    return windows
