"""Three filters on recorded ships: ``python run.py`` writes tables.md and draws ship_track.png.

The exit status is 1 if the page quotes a row that the tables do not have.
"""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from figure import draw
from numpy.typing import NDArray
from prepare import HERE, Floats, Record, record, stretches

import fkgen

LENGTHS = (20.0, 60.0, 120.0)  # s, of the stretches that are taken out
SAILING = 2.0  # m/s: slower ships are taken to lie at a berth
PERIOD, OFFSETS = 200.0, tuple(25.0 * i for i in range(8))  # s, from one stretch to the next
LOST, SEEDS = 0.05, range(10)
KF_NOISES, KF_NOISE = (0.05, 0.1, 0.2), 0.1  # m2/s3, of the kf
TRACKS = ("A", "B", "C")
IMM, KF, LINEAR = "imm", f"kf, {KF_NOISE:g} m2/s3", "mjls_lmmse"
TOLD, LLR, NIS, MODE = f"{KF}, told", "mjls_lmmse, llr", "mjls_lmmse, nis", "imm, loss as a mode"
Rows = list[Sequence[str]]


def content() -> dict[str, Any]:
    """Read spec.toml, to be varied."""
    return tomllib.loads((HERE / "spec.toml").read_text(encoding="utf-8"))


def filters() -> dict[str, fkgen.Spec]:
    """Make all filters: the same ship, the same noise of the reports."""
    table = content()
    plain = plain_filter(KF_NOISE)
    linear = table | {"filter": {"family": "mjls_lmmse"}}
    lossy = copy.deepcopy(table)
    lossy["faults"]["jump"] |= {"arrival": "unknown", "arrival_rate": 1.0 - LOST}
    specs = {
        IMM: table,
        KF: plain,
        TOLD: plain,
        LINEAR: linear,
        LLR: lossy | {"filter": {"family": "mjls_lmmse", "detector": "llr"}},
        NIS: lossy | {"filter": {"family": "mjls_lmmse", "detector": "nis", "alpha": 1e-4}},
        MODE: loss_as_mode(table),
    }
    return {name: fkgen.Spec.from_dict(each, file="spec.toml") for name, each in specs.items()}


def plain_filter(noise: float) -> dict[str, Any]:
    """The kf: one mode, with another process noise."""
    table = content()
    del table["faults"]
    for row in table["model"]["Q"]:
        row[:] = [str(entry).replace("0.02*", f"{noise}*") if entry else entry for entry in row]
    table["filter"] = {"family": "kf"}
    return table


def loss_as_mode(table: dict[str, Any]) -> dict[str, Any]:
    """Every mode twice: with a report that holds the ship, and with one that holds nothing."""
    doubled = copy.deepcopy(table)
    jump, chance = doubled["faults"]["jump"], np.array([1.0 - LOST, LOST])
    nothing = np.zeros((4, 4)).tolist()
    jump["modes"] += [{**mode, "C": nothing} for mode in jump["modes"]]
    jump["transition"] = np.kron(np.outer([1.0, 1.0], chance), jump["transition"]).tolist()
    jump["initial"] = np.kron(chance, jump["initial"]).tolist()
    return doubled


def run(spec: fkgen.Spec, ship: Record) -> fkgen.Run:
    """Filter a ship."""
    out = fkgen.build(spec).run(ship.y, params={"dt": ship.dt})
    if np.any(out.status < 0):
        raise SystemExit(f"{spec.filter.family}: refused samples")
    return out


@dataclass(frozen=True)
class Misses:
    """Predictions of positions, and the reports that they did not see.

    Attributes
    ----------
    error : (M, 2) ndarray
        m.
    covariance : (M, 2, 2) ndarray
        Of the prediction and the report together, m2.
    last : (M,) ndarray of bool
        The last report of a stretch.
    """

    error: Floats
    covariance: Floats
    last: NDArray[np.bool_]

    @property
    def nees(self) -> Floats:
        """Squared error over what is stated, per component."""
        whitened = np.linalg.solve(self.covariance, self.error[..., None])[..., 0]
        return np.einsum("mi,mi->m", self.error, whitened) / 2.0

    @property
    def log_density(self) -> Floats:
        """Log of the density that the prediction gives to the report."""
        determinant = np.linalg.slogdet(2.0 * np.pi * self.covariance)[1]
        return -self.nees - 0.5 * determinant


def sails(ship: Record) -> NDArray[np.bool_]:
    """Instants with a report of a ship under way."""
    return np.hypot(ship.y[:, 2], ship.y[:, 3]) > SAILING


def removals(ship: Record, length: float) -> Iterator[NDArray[np.bool_]]:
    """Stretches of one length, in eight arrangements, that begin while the ship sails."""
    moves = ship.t[ship.reported], sails(ship)[ship.reported]
    for offset in OFFSETS:
        starts = np.arange(60.0 + offset, ship.t[-1] - length, PERIOD)
        before = np.searchsorted(moves[0], starts) - 1
        chosen = starts[(before >= 0) & moves[1][before]]
        yield stretches(ship.t, tuple((start, start + length) for start in chosen))


def misses(spec: fkgen.Spec, ship: Record, length: float) -> Misses:
    """Predict what was taken out of a track."""
    error, covariance, last = [], [], []
    noise = spec.model.R.values()[:2, :2]
    for removed in removals(ship, length):
        out = run(spec, ship.without(removed))
        unseen = np.flatnonzero(removed & ship.reported)
        error.append(out.filtered_state[unseen, :2] - ship.y[unseen, :2])
        covariance.append(out.filtered_covariance[unseen, :2, :2] + noise)
        last.append(np.append(np.diff(ship.t[unseen]) > PERIOD / 4.0, True))
    return Misses(*(np.concatenate(each) for each in (error, covariance, last)))


def rms(errors: Floats) -> float:
    """Root of the mean squared length of vectors."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def stretch_table(specs: dict[str, fkgen.Spec]) -> Rows:
    """Predictions of stretches of track A."""
    ship = record("A")
    rows: Rows = [["taken out", "filter", "RMS, m", "at the end, m", "NEES", "log density"]]
    for length in LENGTHS:
        for name in (IMM, KF, LINEAR):
            found = misses(specs[name], ship, length)
            errors = f"{rms(found.error):.1f}", f"{rms(found.error[found.last]):.1f}"
            fit = f"{found.nees.mean():.2f}", f"{found.log_density.mean():.2f}"
            rows.append([f"{length:.0f} s", name, *errors, *fit])
    return rows


def both_table(specs: dict[str, fkgen.Spec]) -> Rows:
    """Log densities of the next report and of those of a removed minute, and the NEES of these."""
    rows: Rows = [["filter"]]
    for track in TRACKS:
        rows[0] = [*rows[0], f"{track}: next report", "a minute", "NEES"]
    kalman = {f"kf, {q:g} m2/s3": fkgen.Spec.from_dict(plain_filter(q)) for q in KF_NOISES}
    for name, spec in {IMM: specs[IMM], **kalman, LINEAR: specs[LINEAR]}.items():
        row = [name]
        for track in TRACKS:
            ship = record(track)
            found, next_one = misses(spec, ship, 60.0), run(spec, ship).log_likelihood
            densities = next_one[sails(ship)].mean(), found.log_density.mean()
            row += [*(f"{each:.2f}" for each in densities), f"{found.nees.mean():.2f}"]
        rows.append(row)
    return rows


def corrupted(ship: Record, seed: int) -> tuple[Record, NDArray[np.bool_]]:
    """Reports that hold nothing: noise about zero in all four rows."""
    rng = np.random.default_rng(seed)
    lost = ship.reported & (rng.random(ship.t.size) < LOST)
    noise = rng.standard_normal(ship.y.shape) * np.array([4.0, 6.0, 0.2, 0.2])
    y = np.where(lost[:, None], noise, ship.y)
    return Record(ship.t, ship.dt, y), lost


def declared(name: str, out: fkgen.Run) -> NDArray[np.bool_]:
    """Reports that a filter takes for lost; none if it does not test."""
    if name in {LLR, NIS}:
        return np.asarray(out.fault_declared > 0.5)
    if name == MODE:
        return np.asarray(out.mode_probability[:, 3:].sum(axis=1) > 0.5)
    return np.zeros(len(out.status), bool)


def fault_table(specs: dict[str, fkgen.Spec]) -> Rows:
    """Track A with reports that hold nothing; errors are against the reports that they replaced."""
    ship = record("A")
    rows: Rows = [["filter", "RMS, all reports, m", "RMS, lost ones, m", "false", "found"]]
    for name in (TOLD, MODE, LLR, NIS, LINEAR, KF):
        everywhere, there, false, found = [], [], [], []
        for seed in SEEDS:
            bad, lost = corrupted(ship, seed)
            seen = ship.without(lost) if name == TOLD else bad
            out = run(specs[name], seen)
            error = out.filtered_state[:, :2] - ship.y[:, :2]
            everywhere.append(error[ship.reported])
            there.append(error[lost])
            verdict = declared(name, out)
            false.append(verdict[ship.reported & ~lost])
            found.append(verdict[lost])
        row = [name, *(f"{rms(np.concatenate(each)):.1f}" for each in (everywhere, there))]
        tests = name in {MODE, LLR, NIS}
        shares = [f"{np.concatenate(each).mean():.4f}" for each in (false, found)]
        rows.append([*row, *(shares if tests else ("", ""))])
    return rows


def gap_table(specs: dict[str, fkgen.Spec]) -> Rows:
    """Errors at the first report after a long gap, and what was stated."""
    rows: Rows = [["track", "gap", "filter", "error, m", "stated, m"]]
    for track in "DBE":
        ship = record(track)
        reports = np.flatnonzero(ship.reported)
        after = reports[1 + np.argmax(np.diff(ship.t[reports]))]
        before = reports[np.argmax(np.diff(ship.t[reports]))]
        for name in (IMM, KF, LINEAR):
            out = run(specs[name], ship)
            error = out.predicted_state[after - 1, :2] - ship.y[after, :2]
            stated = np.sqrt(np.trace(out.predicted_covariance[after - 1, :2, :2]))
            gap = f"{(ship.t[after] - ship.t[before]) / 60.0:.1f} min"
            rows.append([track, gap, name, f"{np.linalg.norm(error):.0f}", f"{stated:.0f}"])
    return rows


def markdown(tables: dict[str, Rows]) -> str:
    """Lay the tables out."""
    lines = []
    for title, (head, *body) in tables.items():
        rule = ["---", *["---:"] * (len(head) - 1)]
        lines += ["", f"## {title}", ""]
        lines += ["| " + " | ".join(row) + " |" for row in (head, rule, *body)]
    return "\n".join(lines[1:]) + "\n"


def unsupported(page: str, tables: str) -> list[str]:
    """Rows of tables on the page that the tables do not have."""
    rows = re.findall(r"^\| .* \|$", page, re.MULTILINE)
    numbers = [row for row in rows if re.search(r"\d+\.\d", row) and "---" not in row]
    return [row for row in numbers if row not in tables]


def main() -> None:
    """Print the tables, draw the figure."""
    specs = filters()
    tables = {
        "The next report, and a minute without reports": both_table(specs),
        "Stretches of track A that are taken out": stretch_table(specs),
        "Reports of track A that hold nothing": fault_table(specs),
        "The longest gaps": gap_table(specs),
    }
    text = markdown(tables)
    print(text)
    (HERE / "tables.md").write_text("# Three filters for five ships\n\n" + text, encoding="utf-8")
    ship = record("A")
    kept = ship.without(stretches(ship.t))
    results = {"imm": run(specs[IMM], kept), "kf": run(specs[KF], kept)}
    draw(ship, results).savefig(HERE / "ship_track.png", dpi=110, metadata={"Software": None})
    page = (HERE / "README.md").read_text(encoding="utf-8")
    if wrong := unsupported(page, text):
        raise SystemExit("README.md quotes " + "\n".join(wrong))


if __name__ == "__main__":
    main()
