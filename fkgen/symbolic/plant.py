"""The plant of a spec as CasADi matrices: constants stay constants, zeros stay structural."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import SpecError
from fkgen.faults.chain import LETTERS, Mode
from fkgen.problem import Matrix, Model, Spec
from fkgen.problem.code import CodeForm
from fkgen.problem.covariance import is_singular
from fkgen.symbolic.lifting.equations import Lifted, lift_equations
from fkgen.symbolic.lifting.expressions import Wholes, lift, lift_expression
from fkgen.symbolic.linalg import sparse

#: What of a plant with f and h is about f.
MOTION = ("moved", "A", "B", "G", "variances", "moved_by")

#: States from which on loops over whole matrices are faster than straight lines, if A has few zeros
#: and if it has many: more than so many entries for each that is none.
DENSE_STATES, SPARSE_STATES, SPARSE = 8, 20, 2.5
#: The same where the text is to be small.
SMALL_STATES = 5

#: Operations that may stand in a row; a compiler gets through so many in a second.
STRAIGHT_OPERATIONS, COMPILED_PER_SECOND = 4000, 2500

#: Variances of which four may be multiplied, with some room for those that follow from them.
TAME = 1e-60, 1e60


@dataclass(frozen=True, slots=True, kw_only=True)
class Plant:
    """x[k+1] = A x + B g u + c + v, y = C x + D g u + d + w, with Cov(v) = Q and Cov(w) = R."""

    parameters: Mapping[str, ca.SX]  # Symbols of the run-time parameters
    A: ca.SX  # A, B, C, D, Q, R: (n, n), (n, q), (p, n), (p, q), (n, n), (p, p)
    B: ca.SX
    C: ca.SX
    D: ca.SX
    Q: ca.SX
    R: ca.SX
    c: ca.SX  # (n, 1), (p, 1), known offsets
    d: ca.SX
    S: ca.SX  # (n, p), covariance of the noise of x with that of y
    limits: tuple[ca.SX, ...] = ()  # What must not be negative where A, B, c and Q are computed
    rows: tuple[str, ...]  # Names of the rows of y, for headings in the C code
    scalar: str  # Of the C code, for tolerances
    #: Of the C code: "straight", "loops" over whole matrices, or "auto" where only rows may be many
    code_form: CodeForm
    shows_variance: bool  # The covariance of the innovation is shown
    #: R is singular: rows of y may be exact, so a rank decision is needed when conditioning
    noise_free: bool
    #: Variances follow parameters or are so large or small that products of some overflow
    wide: bool
    #: f and h in place of A, B, C, D, c and d, which are then their derivatives over symbols until
    #: the plant is linearised somewhere
    lifted: Lifted | None = None
    #: The part of the state of each row of the covariance, where there are several and covariances
    #: between them are 0
    parts: tuple[int, ...] = ()
    moved: ca.SX | None = None  # moved, seen: (n, 1), (p, 1), f and h where it is linearised
    seen: ca.SX | None = None
    spread: ca.SX | None = None  # packed G Var(w) G' there, and G
    G: ca.SX | None = None

    @property
    def ne(self) -> int:
        """Number of rows of the covariance of x: n, less one for every attitude."""
        return int(self.A.shape[0])

    @property
    def nx(self) -> int:
        """Number of numbers in x, n."""
        return self.ne + len(self.attitudes)

    @property
    def attitudes(self) -> tuple[int, ...]:
        """Where quaternions begin in x."""
        return () if self.lifted is None else self.lifted.attitudes

    @property
    def wraps(self) -> tuple[int, ...]:
        """Rows of y that are angles."""
        return () if self.lifted is None else self.lifted.wraps

    @property
    def nu(self) -> int:
        """Number of inputs q."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of measurements p."""
        return int(self.C.shape[0])


def plant_of(spec: Spec) -> Plant:
    """Lift the matrices of a spec to CasADi."""
    parameters, model = {p.name: ca.SX.sym(p.name) for p in spec.parameters}, spec.model
    wholes = Wholes(spec, parameters)
    lifted = _lifted(spec, model, parameters)
    stated = [x for x in (*LETTERS, "S") if lifted is None or x in {"Q", "R", "S"}]
    matrices = {letter: lift(getattr(model, letter), parameters, wholes) for letter in stated}
    matrices["Q"] = _over_a_sample(model, matrices["Q"], parameters)
    own: dict[str, Any] = matrices | _derivatives(lifted)
    return Plant(
        parameters=parameters,
        **own,
        limits=tuple(wholes.limits),
        rows=tuple(signal.name for signal in model.outputs),
        scalar=spec.code.scalar,
        code_form=_code_form(spec, matrices["A"] if lifted is None else lifted.A),
        shows_variance=spec.code.shows("innovation_covariance"),
        noise_free=_is_noise_free(model.R),
        wide=_is_wide(model.R) or _is_wide(model.P0),
    )


def _code_form(spec: Spec, A: ca.SX) -> CodeForm:
    """Straight lines or loops: what the spec asks for, or what suits the size of the plant."""
    n, p, entries = A.shape[0], spec.model.ny, A.nnz()
    form = spec.code.form
    rows = p * (4 * n + n * (n + 1))
    operations = (2 * entries * n + entries * (n + 1) + rows) * len(spec.plants)
    if form == "auto":
        dense = n * n <= SPARSE * entries
        least = SMALL_STATES if spec.code.optimise == "size" else DENSE_STATES
        many = n >= (least if dense else SPARSE_STATES)
        return "loops" if many or operations > STRAIGHT_OPERATIONS else "auto"
    if form == "straight" and operations > STRAIGHT_OPERATIONS:
        seconds = max(2, round(operations / COMPILED_PER_SECOND))
        raise SpecError(
            "code.form",
            given=f'"straight" for {n} states and {p} rows of y: about {operations} operations '
            f"in a row, which a compiler needs about {seconds} s for",
            expected=f'at most {STRAIGHT_OPERATIONS}; or form = "auto" or "loops"',
            file=spec.file,
        )
    return form


def _lifted(
    spec: Spec, plant: Model | Mode, parameters: Mapping[str, ca.SX], like: Lifted | None = None
) -> Lifted | None:
    """F and h, where a plant has them."""
    if plant.equations is None:
        return None
    signals = spec.model.states, spec.model.outputs
    return lift_equations(plant.equations, parameters, signals, like)


def _over_a_sample(plant: Model | Mode, Q: ca.SX, parameters: Mapping[str, ca.SX]) -> ca.SX:
    """The covariance of what is added to x, where Q is a density of equations in time."""
    if plant.equations is None or plant.equations.period is None:
        return Q
    return sparse(Q * lift_expression(plant.equations.period, parameters))


def _derivatives(lifted: Lifted | None) -> dict[str, Any]:
    """What stands in place of matrices where a plant has f and h."""
    if lifted is None:
        return {}
    own: dict[str, Any] = {letter: getattr(lifted, letter) for letter in "ABCD"}
    return (
        own
        | {"c": ca.SX(lifted.moved.numel(), 1), "d": ca.SX(lifted.seen.numel(), 1)}
        | {"lifted": lifted}
    )


def sensed_at_prior(
    spec: Spec, plant: Model | Mode, parameters: Mapping[str, float] | None = None
) -> NDArray[np.float64]:
    """C of a plant, or the derivative of its h at x0 and u = 0; parameters are the defaults."""
    at = {**spec.defaults, **(parameters or {})}
    if plant.equations is None:
        return plant.C.values(at)
    named = {p.name: ca.SX.sym(p.name) for p in spec.parameters}
    lifted = lift_equations(plant.equations, named, (spec.model.states, spec.model.outputs))
    symbols = [lifted.x, lifted.u, *named.values()]
    values = [spec.model.x0.values(at), np.zeros(lifted.u.numel()), *(at[name] for name in named)]
    return np.array(ca.Function("C", symbols, [lifted.C])(*values))


def mode_plants(spec: Spec, modes: Sequence[Mode], base: Plant | None = None) -> tuple[Plant, ...]:
    """Lift modes of a spec to CasADi: one set of parameters, and equal matrices are one object."""
    base = plant_of(spec) if base is None else base
    wholes = Wholes(spec, base.parameters)
    known: dict[Any, Any] = {}
    plants = []
    for mode in modes:
        if mode.equations not in known:
            own = _lifted(spec, mode, base.parameters, base.lifted)
            if own is not None and mode.equations is not None:  # what moves alike is one object
                first = known.setdefault(("f", mode.equations.motion), own)
                own = replace(own, **{name: getattr(first, name) for name in MOTION})
            known[mode.equations] = _derivatives(own)
        lifted = dict(known[mode.equations])
        for letter in LETTERS if mode.equations is None else ("Q", "R"):
            key = letter, getattr(mode, letter)
            if key not in known:
                matrix = lift(key[1], base.parameters, wholes)
                if letter == "Q":
                    matrix = _over_a_sample(mode, matrix, base.parameters)
                known[key] = matrix
            lifted[letter] = known[key]
        wide = base.wide or _is_wide(mode.R)
        plants.append(replace(base, noise_free=_is_noise_free(mode.R), wide=wide, **lifted))
    return tuple(replace(plant, limits=tuple(wholes.limits)) for plant in plants)


def _is_noise_free(R: Matrix) -> bool:
    """Whether a constant R is singular."""
    return R.is_constant and is_singular(R.values())


def _is_wide(covariance: Matrix) -> bool:
    """Whether variances may be beyond what products of four of them can hold in double."""
    if not covariance.is_constant:
        return True
    variances = np.diag(covariance.values())
    return any(not TAME[0] <= value <= TAME[1] for value in variances[variances > 0.0])
