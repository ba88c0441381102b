"""Ranges of signals: against a filter in NumPy with its own guards; inside, without a trace."""

from __future__ import annotations

import copy
import os
import subprocess
import sys

import numpy as np
import pytest

import fkgen
from fkgen.estimators import ranges
from fkgen.proof import agreement
from fkgen.symbolic.interface import Status

T = 200
A, B, C = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.0], [0.1]]), np.array([[1, 0], [1, 1]])
Q, R = np.array([[0.01, 0.002], [0.002, 0.05]]), np.array([[0.3, 0.1], [0.1, 0.2]])
x0, P0 = np.array([0.2, -0.1]), np.array([[9.0, 1.0], [1.0, 4.0]])
X, U, Y = ((-0.25, 0.25), (-0.2, 0.3)), (-2.0, 2.0), (None, (-1.5, 1.2))

rng = np.random.default_rng(7)
y = rng.normal(0.3, 1.0, (T, 2))
y[rng.random(y.shape) < 0.1] = np.nan
y[20:40] = np.nan  # variances grow until they are clamped
u = rng.uniform(-1.9, 1.9, (T, 1))


def table(x=X, of_u=U, of_y=Y, **code):
    def signals(letter, spans):
        found = [{"name": f"{letter}_{i}"} for i in range(len(spans))]
        return [each | ({"range": [*s]} if s else {}) for each, s in zip(found, spans, strict=True)]

    model = {"A": A, "B": B, "C": C, "Q": Q, "R": R, "x0": x0, "P0": P0}
    model |= {"states": signals("s", x), "inputs": signals("v", (of_u,))}
    model["outputs"] = signals("m", of_y)
    return {"name": "ranged", "model": model, "filter": {"family": "kf"}, "code": code}


def build(given):
    return fkgen.build(fkgen.Spec.from_dict(given))


@pytest.fixture(scope="module")
def guarded():
    return build(table())


def clamped(x, P):
    """A state in its range, a covariance scaled from both sides."""
    low, high = np.array(X).T
    scale = np.minimum(1.0, (high - low) / np.sqrt(np.diag(P)))
    return np.clip(x, low, high), scale[:, None] * P * scale


def expected(measured, driven):
    """What the filter gives, from the textbook; rows out of range are left out."""
    x, P = x0, P0
    found = {name: [] for name in ("filtered", "filtered_P", "predicted", "predicted_P", "nis")}
    for k in range(len(measured)):
        with np.errstate(invalid="ignore"):
            out = (measured[k] < [-np.inf, Y[1][0]]) | (measured[k] > [np.inf, Y[1][1]])
        rows = np.flatnonzero(np.isfinite(measured[k]) & ~out)
        H = C[rows]
        S = H @ P @ H.T + R[np.ix_(rows, rows)]
        nu, K = (measured[k, rows] - H @ x), P @ H.T @ np.linalg.inv(S)
        found["nis"].append(nu @ np.linalg.inv(S) @ nu)
        x, P = clamped(x + K @ nu, P - K @ S @ K.T)
        found["filtered"].append(x)
        found["filtered_P"].append(P)
        x, P = clamped(A @ x + B @ driven[k], A @ P @ A.T + Q)
        found["predicted"].append(x)
        found["predicted_P"].append(P)
    return {name: np.array(values) for name, values in found.items()}


def test_the_filter_is_the_one_with_guards_in_numpy(guarded):
    run, told = guarded.run(y, u), expected(y, u)
    out = (y[:, 1] < Y[1][0]) | (y[:, 1] > Y[1][1])
    assert out.sum() > 10
    assert all((told["filtered"] == bounds).any() for bounds in np.array(X).T)
    widths = np.diff(X)[:, 0]
    assert np.allclose([told["filtered_P"][:, i, i].max() for i in range(2)], widths**2)
    names = (
        "filtered_state",
        "filtered_covariance",
        "predicted_state",
        "predicted_covariance",
        "nis",
    )
    for name, values in zip(names, told.values(), strict=True):
        np.testing.assert_allclose(run[name], values, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(run.rejected, np.stack([np.zeros(T, bool), out], 1))
    np.testing.assert_array_equal(np.isnan(run.innovation), np.isnan(y) | run.rejected)
    missing = np.isnan(y).all(1)
    np.testing.assert_array_equal(run.status, np.where(out, 2, np.where(missing, 1, 0)))


#: What y tells of beside the state: of the noise of x, or of which inputs arrive.
S, D = np.array([[0.04, 0.01], [0.0, -0.06]]), np.array([[0.0], [0.4]])
WIDE = 9.0 * R  # so that variances are clamped where rows are present


def beside(which, rate=0.7):
    """A spec in which y does, and y = H (x, e) + v, v with S of e, e of variance V, x moved by G e.

    H, G and V are of u. Of `kf` e is the noise of x; of `mkf` an input, above its mean.
    """
    given = table(of_y=(None, None))
    given["model"]["R"] = WIDE
    if which == "S":
        given["model"]["S"] = S
        return given, lambda _: (np.hstack([C, np.zeros((2, 2))]), np.eye(2), Q, 0.0 * Q, S)
    given["model"]["D"] = D
    given["filter"], given["faults"] = {"family": "mkf"}, {"actuator": {"success_rate": rate}}
    V, none = np.array([[rate * (1.0 - rate)]]), np.zeros((1, 2))
    return given, lambda u: (np.hstack([C, D * u]), B * u, V, Q, none)


@pytest.mark.parametrize("which", ["S", "D"])
@pytest.mark.parametrize("form", ["joseph", "ud"])
def test_what_y_tells_of_beside_a_state_is_clamped_with_it(which, form):
    """A correction widens nothing: what is clamped after one is the first after a wide prior."""
    given, of = beside(which)
    filter_, width = build({**given, "code": {"update": form}}), np.diff(X)[:, 0]
    mean, direct, clamps = (0.7, 0.7 * D, 0) if which == "D" else (1.0, 0.0 * D, 0)
    for k in range(60):
        x, P = x0, P0
        run = filter_.run(y[k : k + 3], u[k : k + 3])
        for i in range(3):
            (now,), measured = u[k + i], y[k + i]
            H, G, V, rest, shared = of(now)
            rows = np.flatnonzero(~np.isnan(measured))
            joint = np.block([[P, np.zeros((2, len(V)))], [np.zeros((len(V), 2)), V]])
            told = joint @ H.T + np.vstack([np.zeros((2, 2)), shared])
            whole = H @ joint @ H.T + WIDE
            K = told[:, rows] @ np.linalg.inv(whole[np.ix_(rows, rows)])
            both = np.r_[x, 0.0 * V[0]] + K @ (measured - C @ x - direct[:, 0] * now)[rows]
            joint = joint - K @ told[:, rows].T
            scale = np.r_[np.minimum(1.0, width / np.sqrt(np.diag(joint)[:2])), np.ones(len(V))]
            clamps += bool((scale < 1.0).any() and len(rows))
            joint = scale[:, None] * joint * scale
            np.testing.assert_allclose(run.filtered_covariance[i], joint[:2, :2], atol=1e-12)
            x, through = np.clip(both[:2], *np.array(X).T), np.hstack([A, G])
            np.testing.assert_allclose(run.filtered_state[i], x, atol=1e-12)
            x = A @ x + mean * B[:, 0] * now + G @ both[2:]
            x, P = clamped(x, through @ joint @ through.T + rest)
            np.testing.assert_allclose(run.predicted_state[i], x, atol=1e-12)
            np.testing.assert_allclose(run.predicted_covariance[i], P, atol=1e-12)
    assert clamps > 20


@pytest.mark.parametrize(
    "family", ["kf", "iekf", "mkf", "genie", "mme", "mme, D", "one_step", "paper"]
)
def test_factors_are_clamped_as_their_covariance_is(family):
    """The Joseph form is clamped by entries of P, factors by rows of U and D: one filter."""
    given = table(of_y=(None, None))
    if family == "mme, D":
        family, given["model"]["D"] = "mme", D
    given["model"]["A"] = np.tril(A)  # rows of U are not in the order of states
    given["filter"] = {"family": family}
    sensor = {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.8, "noise_factor": 9.0}
    given["faults"] = {
        "kf": {},
        "iekf": {},
        "mkf": {"actuator": {"success_rate": 0.7}},
        "mme": {"actuator": {}},
    }.get(family, {"sensor": sensor | {"rows": ["m_0"]}})
    if family == "mme":
        given["filter"]["hypotheses"] = [0.3, 0.9]
    if family == "paper":
        given["filter"] = {"family": "one_step", "covariance": "paper"}
    told = {"gamma": 1.0, "delta": 1.0} if family == "genie" else None
    runs = {}
    for form in ("joseph", "ud"):
        runs[form] = build({**given, "code": {"update": form}}).run(y, u, told)
    widths = np.diff(X)[:, 0]
    P = runs["ud"].filtered_covariance
    assert np.allclose([P[:, i, i].max() for i in range(2)], widths**2)
    for port in set(runs["joseph"].ports) - {"status"}:
        np.testing.assert_allclose(runs["ud"][port], runs["joseph"][port], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_inside_its_ranges_no_bit_changes(scalar):
    wide = table(((-50.0, 50.0), None), (-50.0, 50.0), ((-99.0, 99.0), None), scalar=scalar)
    bare = table((None, None), None, (None, None), scalar=scalar)
    run, free = build(wide).run(y, u), build(bare).run(y, u)
    for port in free.ports:
        np.testing.assert_array_equal(run[port], free[port])
    assert not run.rejected.any()


def test_compiled_code_gives_the_bits_of_interpreter_and_statements(monkeypatch):
    straight = fkgen.validate(fkgen.Spec.from_dict(table()))
    monkeypatch.setattr(ranges, "LOOPED", 1)
    looped = fkgen.validate(fkgen.Spec.from_dict(table()))
    record = agreement.trial(straight.spec)
    record.y[3:6] *= 100.0
    claims = [agreement.with_machine(fkgen.generate(each), record) for each in (straight, looped)]
    claims.append(agreement.with_interpreter(straight))
    assert all(claim.holds for each in claims for claim in each)
    one, other = (fkgen.compile(fkgen.generate(each)).run(y, u) for each in (straight, looped))
    for port in one.ports:
        np.testing.assert_array_equal(one[port], other[port])


def test_a_batch_gives_the_bits_of_its_records(guarded):
    records = np.stack([y * scale for scale in (1.0, 0.1, 3.0, 1.0, -1.0, 0.0, 1.0, 0.2, 0.3)])
    driven = np.stack([u] * 9)
    driven[4, 7] = 2.5
    batch = guarded.run_batch(records, driven)
    for m in range(9):
        run = guarded.run(records[m], driven[m])
        np.testing.assert_array_equal(batch.status[m], run.status)
        for port in run.ports:
            np.testing.assert_array_equal(batch[port][m], run[port])


def test_an_input_out_of_range_is_refused_and_its_sample_held(guarded):
    driven = u.copy()
    driven[5] = 2.0000001
    run = guarded.run(y, driven)
    assert run.status[5] == Status.INPUT_OUT_OF_RANGE.value
    assert run.held.tolist() == [k == 5 for k in range(T)]
    np.testing.assert_array_equal(run.filtered_state[5], run.filtered_state[4])
    guarded.reset()
    before = guarded.snapshot()
    calls = ((guarded.step, (y[0],)), (guarded.update, (y[0],)), (guarded.predict, ()))
    for call, given in calls:
        with pytest.raises(fkgen.StepRefused, match="RANGED_INPUT_OUT_OF_RANGE"):
            call(*given, [-2.1])
        assert guarded.snapshot() == before
    guarded.step(y[0], [2.0])


def test_a_row_out_of_range_alone_is_a_fault_and_corrects_nothing(guarded):
    guarded.reset(P0=0.05 * np.eye(2))
    prior = guarded.snapshot()
    snapshot = guarded.update([np.nan, 1.3], [0.0])
    assert snapshot.status == Status.FAULT_DECLARED.value
    assert snapshot.rejected.tolist() == [False, True]
    np.testing.assert_array_equal(snapshot.filtered_state, prior.predicted_state)
    later = guarded.update([0.1, 1.2], [0.0])  # what was left out was no use of the sample
    guarded.reset(P0=0.05 * np.eye(2))
    once = guarded.update([0.1, 1.2], [0.0])
    np.testing.assert_allclose(later.filtered_state, once.filtered_state, rtol=1e-12)
    assert (later.status, later.rejected.any()) == (0, False)


def test_a_start_out_of_range_is_refused(guarded):
    with pytest.raises(fkgen.FkgenError, match="range"):
        guarded.reset(x0=[0.6, 0.0])
    with pytest.raises(fkgen.FkgenError, match="range"):
        guarded.run(y, u, start={"x0": [0.0, -0.31]})
    guarded.reset(x0=[0.25, 0.3])


def test_a_gate_and_ranges_reject_side_by_side():
    given = table(of_y=((-1e6, 1e6), (-1e6, 1e6)), ports=[])
    given["filter"]["gate"] = 0.9999
    both = build(given)
    run = both.run([[0.0, 0.0], [2e6, 0.1], [5e5, 0.1], [0.0, 5e5]], np.zeros((4, 1)))
    assert run.rejected.tolist() == [[False, False], [True, False], [True, False], [False, True]]
    assert run.status.tolist() == [0, 2, 2, 2]


def test_modes_stay_in_range_and_inside_nothing_changes():
    given = table((None, None), None, (None, None))
    given["filter"] = {"family": "imm"}
    modes = [{}, {"A": A * 0.9, "R": R * 4.0}]
    given["faults"] = {"jump": {"transition": [[0.9, 0.1], [0.2, 0.8]], "modes": modes}}
    found = {}
    for width in (None, 1e5, 1.0):
        each = copy.deepcopy(given)
        for state in each["model"]["states"] if width else ():
            state["range"] = [-width, width]
        found[width] = build(each).run(y * 3, u)
    for port in found[None].ports:
        np.testing.assert_array_equal(found[1e5][port], found[None][port])
    for of in ("mode_", "mode_filtered_", "filtered_", "predicted_"):
        assert np.abs(found[1.0][f"{of}state"]).max() == 1.0
        P = found[1.0][f"{of}covariance"][1:]
        assert np.diagonal(P, axis1=-2, axis2=-1).max() <= 4.0
        assert np.linalg.eigvalsh(P).min() > 0.0


def test_the_same_spec_gives_the_same_bytes():
    text = (
        "import fkgen, sys, ast; s = fkgen.Spec.from_dict(ast.literal_eval(sys.argv[1]));"
        "t = fkgen.generate(fkgen.validate(s)).files['ranged.c']; print(t)"
    )
    given = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in table()["model"].items()}
    spec = repr({**table(), "model": given})
    found = {
        subprocess.run(
            [sys.executable, "-c", text, spec],
            env={**os.environ, "PYTHONHASHSEED": seed},
            check=True,
            capture_output=True,
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(found) == 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"x": ((0.3, 0.5), None)},
            r"model.states.s_0.range: given \[0.3, 0.5\]; .* x0\[0\] = 0.2",
        ),
        ({"x": ((0.5, 0.1), None)}, r"model.states\[0\].range: given \[0.5, 0.1\]; .* low < high"),
        ({"of_u": (1.0,)}, r"model.inputs\[0\].range: given 1 entries; .* two finite numbers"),
        ({"of_y": ((0.0, float("inf")), None)}, r"model.outputs\[0\].range\[1\]: given inf"),
    ],
)
def test_a_range_that_cannot_be_is_an_error_of_the_spec(change, told):
    with pytest.raises(fkgen.SpecError, match=told):
        fkgen.Spec.from_dict(table(**change))


def test_a_range_of_a_state_is_refused_where_more_than_estimates_is_kept():
    given = table()
    given["filter"] = {"family": "linear_optimal"}
    given["faults"] = {"sensor": {"problem": 3, "gamma_chain": [[0.9, 0.1], [0.1, 0.9]]}}
    with pytest.raises(fkgen.SpecError, match=r"family linear_optimal: .* keeps moments"):
        fkgen.Spec.from_dict(given)
