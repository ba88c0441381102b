"""Turn the pulse test into a record: ``python prepare.py --data FOLDER`` writes record.csv.

The tester reports a current when its interval is over, and rests a minute or more without a row.
The record says what flows as soon as it is known, so that nothing is counted for too long.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
FAST, SLOW = 1.0, 5.0  # s between rows, where current flows or has just changed, and elsewhere
COLUMNS = ("t_s", "sensor", "voltage", "true_current", "true_soc")
SEED = 1
FAILS, LASTS = 300.0, 60.0  # s: a contact opens that often, for so long, on average
NOISE = 0.05  # A, of the sensor
FLOWS, CHANGES, AFTER = 0.05, 0.5, 60.0  # A, A, s
RESTED = 3000.0  # s after which a voltage counts as that of the open circuit
NEARLY_EMPTY = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.045])  # where no rest was
ABOVE = 0.3  # the table goes on straight by this much
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Test:
    """The tester's rows from full charge on, T of them.

    Attributes
    ----------
    t, current, voltage : (T,) ndarray
        s, A (positive: charge; held over the interval that ends at the row), V.
    charge : (T,) ndarray
        Counted from full charge, Ah.
    step : (T,) ndarray
        The tester's number of what it did.
    rests : (T,) ndarray of bool
    """

    t: Floats
    current: Floats
    voltage: Floats
    charge: Floats
    step: NDArray[np.integer[Any]]
    rests: NDArray[np.bool_]

    @property
    def soc(self) -> Floats:
        """State of charge: 1 at the first row, 0 at the last."""
        return np.asarray(1.0 - self.charge / self.charge[-1])


@dataclass(frozen=True)
class Record:
    """What a filter gets, and what it is judged by; T rows.

    Attributes
    ----------
    t, dt : (T,) ndarray
        Time, and time to the next row, s; 0 at the last one.
    current, voltage : (T,) ndarray
        A, V; no voltage (NaN) in rows that only say that the current has changed.
    soc : (T,) ndarray
        By counted charge.
    """

    t: Floats
    dt: Floats
    current: Floats
    voltage: Floats
    soc: Floats


def tested(path: Path) -> Test:
    """Read the test from full charge on."""
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    rows = rows[np.flatnonzero(rows["mode"] == "REST")[0] :]
    t, current = rows["t_s"], rows["current_A"]
    charge = np.append(0.0, np.cumsum(current[1:] * np.diff(t)) / 3600.0)
    return Test(t, current, rows["voltage_V"], charge, rows["step"], rows["mode"] == "REST")


def open_circuit(test: Test) -> tuple[Floats, Floats]:
    """Make the table of the spec: state of charge, and voltage (V) without current.

    Ends of long rests. Below the last one, the last discharge, raised by what the rest before it
    raised the voltage; above the first one a straight line.
    """
    ends = np.append(np.flatnonzero(np.diff(test.step)), test.t.size - 1)
    begins = np.append(0, ends[:-1])
    rested = test.rests[ends] & (test.t[ends] - test.t[begins] > RESTED)
    rested[0] = True  # the rest after the charge
    soc, voltage = test.soc[ends[rested]][::-1], test.voltage[ends[rested]][::-1]
    last = slice(begins[-1] + 1, None)
    raised = voltage[0] - test.voltage[begins[-2]]
    low = np.interp(NEARLY_EMPTY, test.soc[last][::-1], test.voltage[last][::-1]) + raised
    slope = (voltage[-1] - voltage[-2]) / (soc[-1] - soc[-2])
    x = np.concatenate([NEARLY_EMPTY, soc, [soc[-1] + ABOVE]])
    return x, np.concatenate([low, voltage, [voltage[-1] + ABOVE * slope]])


def thinned(test: Test) -> Record:
    """Leave out rows where nothing happens, and say at once what flows in a gap."""
    rows = list[tuple[float, float, float, float]]()
    changed = -np.inf
    for k in range(test.t.size):
        t, current, soc = test.t[k], test.current[k], test.soc[k]
        if k and abs(current - test.current[k - 1]) > CHANGES:
            changed = t
        if k and t - test.t[k - 1] > 1.5 * SLOW:
            soon = test.t[k - 1] + FAST
            since = current * (t - soon) / 3600.0 / -test.charge[-1]
            rows.append((soon, current, np.nan, soc - since))
        wait = FAST if abs(current) > FLOWS or t - changed < AFTER else SLOW
        if not rows or t - rows[-1][0] >= wait - 0.05:
            rows.append((t, current, test.voltage[k], soc))
    t, current, voltage, soc = np.array(rows).T
    return Record(t, np.append(np.diff(t), 0.0), current, voltage, soc)


def drop_outs(record: Record, seed: int) -> Floats:
    """Make the sensor's current of the true one: noise, and 0 where the contact is open, A."""
    rng = np.random.default_rng(seed)
    turns, noise = rng.random(record.t.size), NOISE * rng.standard_normal(record.t.size)
    signal = np.ones(record.t.size, dtype=bool)
    for k in range(1, record.t.size):
        stays = np.exp(-record.dt[k - 1] / (FAILS if signal[k - 1] else LASTS))
        signal[k] = signal[k - 1] ^ (turns[k] < 1.0 - stays)
    return np.where(signal, record.current, 0.0) + noise


def read() -> Record:
    """Read what `make` wrote, without the sensor."""
    t, _, voltage, current, soc = np.genfromtxt(HERE / "record.csv", delimiter=",", skip_header=1).T
    return Record(t, np.append(np.diff(t), 0.0), current, voltage, soc)


def make(data: Path, target: Path) -> Record:
    """Write record.csv, with the drop-outs of `SEED`; an empty field is missing."""
    record, text = thinned(tested(data / "hppc_25c.csv")), StringIO()
    sensor = drop_outs(record, SEED)
    rows = np.column_stack([record.t, sensor, record.voltage, record.current, record.soc])
    formats = ["%.1f", "%.2f", "%.3f", "%.2f", "%.5f"]
    np.savetxt(text, rows, formats, delimiter=",", header=",".join(COLUMNS), comments="")
    (target / "record.csv").write_text(text.getvalue().replace("nan", ""), encoding="utf-8")
    return record


def main() -> None:
    """Write record.csv and print the table of the spec."""
    parser = argparse.ArgumentParser(description="Write record.csv.")
    parser.add_argument("--data", type=Path, required=True, help="the folder of the data set")
    data = parser.parse_args().data
    record = make(data, HERE)
    test = tested(data / "hppc_25c.csv")
    print(f"record.csv: {record.t.size} rows of {test.t.size}, {-test.charge[-1]:.3f} Ah")
    for name, values in zip("xy", open_circuit(test), strict=True):
        print(f"{name} = {values.round(4).tolist()}")


if __name__ == "__main__":
    main()
