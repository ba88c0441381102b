"""Smoothers, fixed lag and late rows against the joint Gaussian of the whole record."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner
from plants import interpreted
from toolchain import needs_compiler

import fkgen
from fkgen.cli import main
from fkgen.errors import StepRefused
from fkgen.estimators.hindsight import backwards

pytestmark = needs_compiler()

T = 24
LEVEL = 1e-9

DT = {"dt": {"default": 0.1, "min": 0.0, "max": 1.0}}
PLANT = {
    "A": [[1.0, "dt"], [0.0, 0.95]],
    "B": [[0.1], [1.0]],
    "C": [[1.0, 0.0], [0.3, "1 + dt"]],
    "D": [[0.5], [0.1]],
    "Q": [[0.0, 0.0], [0.0, 0.1]],
    "R": [["0.2 + dt", 0.05], [0.05, 0.3]],
    "c": [0.1, 0.2],
    "d": [0.3, "dt"],
    "x0": [1.0, 2.0],
    "P0": [[2.0, 0.3], [0.3, 1.0]],
    "outputs": [{"name": "gps"}, {"name": "wheel"}],
}
SHARED = {"S": [[0.0, 0.0], [0.05, -0.03]]}
APART = {"R": [["0.2 + dt", 0.0], [0.0, 0.3]]}
ACTUATOR = {"actuator": {"success_rate": 0.7}}
SENSOR = {"sensor": {"noise_factor": 9.0, "rows": [0]}}


def table(name, model=None, family="kf", faults=None, delays=(0, 0), code=None, **options):
    outputs = [
        signal | ({"max_delay": most} if most else {})
        for signal, most in zip(PLANT["outputs"], delays, strict=True)
    ]
    return {
        "name": name,
        "model": PLANT | (model or {}) | {"outputs": outputs},
        "parameters": DT,
        "faults": faults or {},
        "filter": {"family": family, **options},
        "code": code or {},
    }


def built(*given, **options):
    return fkgen.build(fkgen.Spec.from_dict(table(*given, **options)))


@pytest.fixture(scope="module")
def record():
    """Rows, inputs and parameters, some rows missing."""
    rng = np.random.default_rng(7)
    y = rng.normal(size=(T, 2)) * 2.0
    y[rng.random(y.shape) < 0.2] = np.nan
    y[5] = np.nan
    params = {"dt": rng.uniform(0.05, 0.3, T)}
    params["gamma"] = (rng.random(T) < 0.7) * 1.0
    params["delta"] = np.where(rng.random(T) < 0.5, 1.0, 9.0)
    return y, rng.normal(size=(T, 1)), params


def matrices(model, dt):
    """A plant at one sample."""

    def value(entry):
        return eval(entry, {"dt": dt}) if isinstance(entry, str) else entry  # noqa: S307

    found = {
        key: np.array([[value(e) for e in np.atleast_1d(row)] for row in model[key]], float)
        for key in "ABCDQRcd"
    }
    found["S"] = np.array(model.get("S", np.zeros((2, 2))), float)
    return found


class Joint:
    """All states and rows of a record as sums of x[0] and noises, and what is known of those."""

    def __init__(self, model, record, *, rate=1.0, told=False, prior=None, delays=None):
        _, u, params = record
        x0, P0 = prior or (model["x0"], model["P0"])
        size = 2 + 5 * T
        law, G, mean = np.zeros((size, size)), np.eye(2, size), np.array(x0, float)
        law[:2, :2] = P0
        self.states, seen, noise = [], [], []
        for k in range(T):
            m = matrices(model, params["dt"][k])
            at = 2 + 5 * k  # w, v, and what gamma is off by
            law[at : at + 2, at : at + 2], law[at + 2 : at + 4, at + 2 : at + 4] = m["Q"], m["R"]
            law[at : at + 2, at + 2 : at + 4] = m["S"]
            law[at + 2 : at + 4, at : at + 2] = m["S"].T
            law[at + 4, at + 4] = rate * (1.0 - rate)
            signal, factor = np.ones(2), np.ones(2)
            if told:
                signal[0], factor[0] = params["gamma"][k], np.sqrt(params["delta"][k])
            off = np.zeros((1, size))
            off[0, at + 4] = u[k, 0]
            self.states.append((mean, G))
            own = m["D"] @ (rate * u[k]) + m["d"][:, 0]
            seen.append(
                (signal * (m["C"] @ mean + own), signal[:, None] * (m["C"] @ G + m["D"] @ off))
            )
            noise.append(factor[:, None] * np.eye(2, size, at + 2))
            mean = m["A"] @ mean + m["B"] @ (rate * u[k]) + m["c"][:, 0]
            G = m["A"] @ G + m["B"] @ off + np.eye(2, size, at)
        self.law = law
        delays = np.zeros((T, 2), int) if delays is None else delays
        #: (k, i): mean and weights of row i that comes at sample k; none from before sample 0
        self.rows = {
            (k, i): (
                seen[k - delays[k, i]][0][i],
                seen[k - delays[k, i]][1][i] + noise[k][i],
            )
            for k in range(T)
            for i in range(2)
            if k >= delays[k, i]
        }

    def given(self, y, at, until=T):
        """Mean and covariance of x[at] given the rows before sample ``until``."""
        rows = [(k, i) for k, i in self.rows if k < until and np.isfinite(y[k, i])]
        H = np.array([self.rows[row][1] for row in rows]).reshape(len(rows), len(self.law))
        e = np.array([y[row] - self.rows[row][0] for row in rows])
        mean, G = self.states[at]
        K = np.linalg.solve(H @ self.law @ H.T, H @ self.law @ G.T).T
        return mean + K @ e, (G - K @ H) @ self.law @ (G - K @ H).T

    def all_given(self, y, at, until):
        found = [self.given(y, a, u) for a, u in zip(at, until, strict=True)]
        return [np.array(each) for each in zip(*found, strict=True)]


def close(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=LEVEL, atol=LEVEL * np.abs(other).max())


def smoothed_as(filter_, joint, record, y=None, **options):
    y, (_, u, params) = record[0] if y is None else y, record
    params = {
        name: value for name, value in params.items() if name in dict(filter_.layout.parameters)
    }
    found = filter_.smooth(record[0], u, params, **options)
    close((found.state, found.covariance), joint.all_given(y, range(T), [T] * T))
    return found


# ---- smoothers


@pytest.fixture(scope="module")
def correlated():
    return built("hind_kf", SHARED, lag=3)


def test_a_smoothed_record_is_the_joint_gaussian(correlated, record):
    found = smoothed_as(correlated, Joint(PLANT | SHARED, record), record)
    assert found.approximate is False
    assert (found.status >= 0).all()
    assert found.state.shape == (T, 2)


def test_it_begins_with_the_prior_that_is_given(correlated, record):
    prior = [3.0, -1.0], [[1.0, 0.2], [0.2, 3.0]]
    start = dict(zip(("x0", "P0"), prior, strict=True))
    smoothed_as(correlated, Joint(PLANT | SHARED, record, prior=prior), record, start=start)


def test_it_goes_on_from_a_snapshot(correlated, record):
    y, u, params = record
    whole = correlated.run(y, u, {"dt": params["dt"]})
    for k in range(4):
        correlated.step(y[k], u[k], {"dt": float(params["dt"][k])})
    here = correlated.snapshot()
    rest = correlated.smooth(y[4:], u[4:], {"dt": params["dt"][4:]}, start=here)
    all_of_it = correlated.smooth(y, u, {"dt": params["dt"]})
    close((rest.state, rest.covariance), (all_of_it.state[4:], all_of_it.covariance[4:]))
    close((rest.state[-1:],), (whole.filtered_state[-1:],))
    correlated.reset()


def test_refused_samples_are_missing_and_held_ones_are_not_there(correlated, record):
    y, u, params = (record[0].copy(), record[1], {"dt": record[2]["dt"].copy()})
    y[4, 0] = np.inf
    params["dt"][[0, 9]] = np.nan
    found = correlated.smooth(y, u, params)
    assert found.status[[0, 4, 9]].tolist() == [-4, -2, -4]
    there = np.delete(np.arange(T), [0, 9])
    y[4] = np.nan
    rest = correlated.smooth(y[there], u[there], {"dt": params["dt"][there]})
    close((found.state[there], found.covariance[there]), (rest.state, rest.covariance))
    np.testing.assert_array_equal(found.state[[0, 9]], found.state[[1, 8]])


def test_pieces_of_a_record_give_what_the_whole_does(correlated, record, monkeypatch):
    y, u, params = record
    whole = correlated.smooth(y, u, {"dt": params["dt"]})
    monkeypatch.setattr(backwards, "PIECE", 7)
    pieces = correlated.smooth(y, u, {"dt": params["dt"]})
    close((pieces.state, pieces.covariance), (whole.state, whole.covariance))


@pytest.fixture(scope="module")
def random_inputs():
    return built("hind_mkf", family="mkf", faults=ACTUATOR, lag=2)


@pytest.fixture(scope="module")
def genie():
    return built("hind_genie", family="genie", faults=SENSOR, lag=2)


def test_mkf_and_genie_are_smoothed_as_their_joint_gaussians(random_inputs, genie, record):
    smoothed_as(random_inputs, Joint(PLANT, record, rate=0.7), record)
    smoothed_as(genie, Joint(PLANT, record, told=True), record)


def test_a_state_without_noise_that_dies_away_does_no_harm():
    """The gain of the textbook's smoother is 1/0.9 a sample there, and rounding would grow."""
    model = {"A": [[0.9]], "B": [[1.0]], "C": [[1.0]], "Q": [[0.0]], "R": [[1.0]]}
    table = {"name": "hind_dies", "model": model | {"x0": [0.0], "P0": [[1e8]]}}
    dying = fkgen.build(fkgen.Spec.from_dict(table | {"filter": {"family": "kf"}}))
    rng, k = np.random.default_rng(3), np.arange(5000)
    y, u = rng.normal(size=(5000, 1)), rng.normal(size=(5000, 1))
    forced = np.zeros(5000)
    for i, j in pairwise(range(5000)):
        forced[j] = 0.9 * forced[i] + u[i, 0]
    seen = 0.9**k  # of x[0]
    variance = 1.0 / (1e-8 + seen @ seen)
    first = variance * (seen @ (y[:, 0] - forced))
    found = dying.smooth(y, u)
    np.testing.assert_allclose(found.state[:, 0], forced + seen * first, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.covariance[:60, 0, 0], variance * seen[:60] ** 2, rtol=1e-9)
    assert (found.covariance >= 0.0).all()


CURVED = {
    "states": [{"name": "x"}, {"name": "y"}, {"name": "heading", "wrap": True}],
    "inputs": [{"name": "v"}],
    "outputs": [{"name": "range"}, {"name": "bearing", "wrap": True}],
    "noises": [{"name": "turn", "variance": 0.01}],
    "f": {
        "x": "x + 0.1*v*cos(heading)",
        "y": "y + 0.1*v*sin(heading)",
        "heading": "heading + turn",
    },
    "h": {"range": "hypot(x, y)", "bearing": "atan2(y, x)"},
    "Q": np.diag([0.01, 0.01, 0.0]).tolist(),
    "R": [[0.1, 0.0], [0.0, 0.01]],
    "x0": [5.0, 5.0, 0.0],
    "P0": np.eye(3).tolist(),
}


def test_a_curved_plant_is_smoothed_as_rauch_tung_and_striebel_do_and_says_so():
    table = {"name": "hind_ekf", "model": CURVED, "filter": {"family": "ekf", "lag": 2}}
    curved = fkgen.build(fkgen.Spec.from_dict(table))
    rng, u, x, y = np.random.default_rng(2), np.ones((40, 1)), np.array([5.0, 5.0, 0.0]), []
    for _ in range(40):
        y.append([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])])
        x = x + [0.1 * np.cos(x[2]), 0.1 * np.sin(x[2]), 0.0] + rng.normal(size=3) * 0.1
    y = np.array(y) + rng.normal(size=(40, 2)) * [0.3, 0.1]
    y[rng.random(y.shape) < 0.2] = np.nan
    run, found = curved.run(y, u), curved.smooth(y, u)
    assert found.approximate is True
    lagged = [(run.filtered_state[-1], run.filtered_covariance[-1])]
    for k in range(38, -1, -1):
        x, P = run.filtered_state[k], run.filtered_covariance[k]
        A = np.eye(3)
        A[:2, 2] = -0.1 * np.sin(x[2]), 0.1 * np.cos(x[2])
        G = P @ A.T @ np.linalg.inv(run.predicted_covariance[k])
        later = lagged[-1][0] - run.predicted_state[k], lagged[-1][1] - run.predicted_covariance[k]
        lagged.append((x + G @ later[0], P + G @ later[1] @ G.T))
    states, covariances = (np.array(each) for each in zip(*lagged[::-1], strict=True))
    close((found.state, found.covariance), (states, covariances))
    close((run.lagged_state[-1:], run.lagged_covariance[-1:]), (states[-3:-2], covariances[-3:-2]))


def test_other_families_say_who_has_a_smoother():
    table = {"name": "hind_iekf", "model": CURVED, "filter": {"family": "iekf"}}
    other = fkgen.build(fkgen.Spec.from_dict(table))
    with pytest.raises(fkgen.DataError, match=r"iekf; expected one of kf, .*imm"):
        other.smooth(np.zeros((3, 2)), np.zeros((3, 1)))


def test_what_a_host_took_over_is_smoothed_by_kf_as_its_joint_gaussian():
    """The filter of a host at an end of a window, and kf's smoother of the rows that it kept."""
    A, C = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.3, 1.0], [1.0, 0.0]])
    Q, R, P0 = np.diag([0.1, 0.2]), np.diag([0.1, 0.5]), np.diag([1.0, 2.0])
    model = {"A": A, "C": C, "Q": Q, "R": R, "x0": [0.0, 0.0], "P0": P0}
    model = {key: np.asarray(value).tolist() for key, value in model.items()}
    soft = {"soft": {"host": [0], "window": 4}}
    table = {"name": "hind_host", "model": model, "faults": soft, "filter": {"family": "dfcf"}}
    host = fkgen.build(fkgen.Spec.from_dict(table))
    y = np.random.default_rng(2).standard_normal((13, 2))
    y[5:9, 1] += 50.0
    run = host.run(y)
    assert run.fault_declared[4::4].tolist() == [0.0, 1.0, 0.0]
    y[5:9, 1] = np.nan
    law = np.zeros((26, 26))
    P = P0
    for k in range(13):
        block = P
        for j in range(k, 13):
            law[2 * j : 2 * j + 2, 2 * k : 2 * k + 2] = block
            law[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = block.T
            block = A @ block
        P = A @ P @ A.T + Q

    def given(until):
        seen = np.flatnonzero(np.isfinite(y[: until + 1]).ravel())
        H = np.kron(np.eye(13), C)[seen]
        G = law @ H.T @ np.linalg.inv(H @ law @ H.T + np.kron(np.eye(13), R)[np.ix_(seen, seen)])
        return (G @ y.ravel()[seen]).reshape(13, 2), law - G @ H @ law

    for end in (4, 8, 12):
        state, covariance = given(end)
        own = covariance[2 * end : 2 * end + 2, 2 * end : 2 * end + 2]
        close((run.filtered_state[end], run.filtered_covariance[end]), (state[end], own))
    with pytest.raises(fkgen.DataError, match="kf of its plant, and NaN for rows of windows"):
        host.smooth(y)
    kf = {"name": "hind_kept", "model": model, "filter": {"family": "kf"}}
    smoothed = fkgen.build(fkgen.Spec.from_dict(kf)).smooth(y)
    state, covariance = given(12)
    own = [covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(13)]
    close((smoothed.state, smoothed.covariance), (state, np.array(own)))


def test_late_rows_are_smoothed_where_they_were_measured_or_not_at_all(alone, record, delays):
    y, u, params = record
    with pytest.raises(fkgen.DataError, match="delay_gps: given rows that come late; expected 0"):
        alone.smooth(y, u, {"dt": params["dt"], "delay_gps": delays[:, 0] * 1.0})
    close((alone.smooth(y, u).state[-1:],), (alone.run(y, u).filtered_state[-1:],))


def test_the_command_writes_states_and_deviations(tmp_path):
    (tmp_path / "walk.toml").write_text(
        'name = "hind_walk"\n[model]\nA = [[1.0]]\nC = [[1.0]]\nQ = [[1.0]]\nR = [[2.0]]\n'
        'x0 = [0.0]\nP0 = [[4.0]]\nstates = [{name = "level"}]\noutputs = [{name = "flow"}]\n'
        '[filter]\nfamily = "kf"\n'
    )
    (tmp_path / "walk.csv").write_text("t,flow\n0,1\n1,\n2,3\n3,inf\n")
    files = [str(tmp_path / name) for name in ("walk.toml", "walk.csv")]
    picture = tmp_path / "walk.svg"
    done = CliRunner().invoke(main, ["smooth", *files, "--plot", str(picture)])
    assert "smoothed" in picture.read_text()
    lines = done.stdout.splitlines()
    assert lines[0] == "t,smoothed_state.level,smoothed_sd.level,status"
    # x[0], x[1], x[2] given 1 and 3: Cov(x[i], x[j]) = 4 + min(i, j)
    H, P = [0, 2], np.array([[4.0, 4, 4, 4], [4, 5, 5, 5], [4, 5, 6, 6], [4, 5, 6, 7]])
    K = P[:, H] @ np.linalg.inv(P[np.ix_(H, H)] + 2.0 * np.eye(2))
    found = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    np.testing.assert_allclose(found[:, 1], K @ [1.0, 3.0], rtol=1e-12)
    np.testing.assert_allclose(found[:, 2], np.sqrt(np.diag(P - K @ P[H])), rtol=1e-12)
    assert found[:, 3].tolist() == [0, 1, 0, -2]
    assert done.exit_code == 1  # a sample was refused
    assert "hind_walk_input_not_finite" in done.stderr.lower()


# ---- fixed lag


def lagged_as(filter_, lag, joint, record, y=None):
    y, (_, u, params) = record[0] if y is None else y, record
    params = {
        name: value for name, value in params.items() if name in dict(filter_.layout.parameters)
    }
    run = filter_.run(record[0], u, params)
    at = [max(k - lag, 0) for k in range(T)]
    expected = joint.all_given(y, at, range(1, T + 1))
    close((run.lagged_state, run.lagged_covariance), expected)
    return run, params


def test_lagged_estimates_are_the_joint_gaussian(correlated, random_inputs, genie, record):
    run, params = lagged_as(correlated, 3, Joint(PLANT | SHARED, record), record)
    assert "past_cross" not in run.ports  # for the filter alone
    batch = correlated.run_batch(np.stack([record[0]] * 9), record[1], params)
    np.testing.assert_array_equal(batch.lagged_covariance[8], run.lagged_covariance)
    lagged_as(random_inputs, 2, Joint(PLANT, record, rate=0.7), record)
    lagged_as(genie, 2, Joint(PLANT, record, told=True), record)


def test_two_updates_of_a_sample_and_predictions_in_a_row_keep_the_past(record):
    filter_ = built("hind_gated", APART, lag=2, gate=0.9)
    y, u, params = record
    run, _ = lagged_as(filter_, 2, Joint(PLANT | APART, record), record, _passed(filter_, record))
    for k in range(T):
        now = u[k], {"dt": float(params["dt"][k])}
        filter_.update([y[k, 0], np.nan], *now)
        last = filter_.update([np.nan, y[k, 1]], *now)
        close(
            (last.lagged_state, last.lagged_covariance),
            (run.lagged_state[k], run.lagged_covariance[k]),
        )
        filter_.predict(*now)


def _passed(filter_, record):
    """The rows that a gate lets pass."""
    y, u, params = record
    run = filter_.run(y, u, {"dt": params["dt"]})
    assert run.rejected.any()
    return np.where(run.rejected, np.nan, y)


# ---- late rows


@pytest.fixture(scope="module")
def delays():
    rng = np.random.default_rng(4)
    found = np.stack([rng.integers(0, 4, T), rng.integers(0, 3, T)], axis=1)
    found[10:14, 0] = 3, 2, 1, 0  # four fixes of one sample
    return found


def late_as(filter_, joint, record, delays):
    y, u, params = record
    given = {f"delay_{n}": delays[:, i] * 1.0 for i, n in enumerate(("gps", "wheel"))} | params
    given = {
        name: value for name, value in given.items() if name in dict(filter_.layout.parameters)
    }
    run = filter_.run(y, u, given)
    expected = joint.all_given(y, range(T), range(1, T + 1))
    close((run.filtered_state, run.filtered_covariance), expected)
    total = 0.0
    used = [(k, i) for k, i in joint.rows if np.isfinite(y[k, i])]
    H = np.array([joint.rows[row][1] for row in used])
    e = np.array([y[row] - joint.rows[row][0] for row in used])
    S = H @ joint.law @ H.T
    total = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    assert run.log_likelihood.sum() == pytest.approx(total, rel=LEVEL)
    assert run.nis.sum() == pytest.approx(e @ np.linalg.solve(S, e), rel=LEVEL)
    return run, given


def test_late_rows_that_R_ties_to_others_are_the_joint_gaussian(record, delays):
    filter_ = built("hind_tied", SHARED, delays=(3, 2))
    joint = Joint(PLANT | SHARED, record, delays=delays)
    run, given = late_as(filter_, joint, record, delays)
    batch = filter_.run_batch(np.stack([record[0]] * 9), record[1], given)
    np.testing.assert_array_equal(batch.filtered_state[8], run.filtered_state)
    np.testing.assert_array_equal(batch.status[8], run.status)


@pytest.fixture(scope="module")
def alone():
    return built("hind_alone", APART, delays=(3, 2))


def test_late_rows_with_noises_of_their_own_are_the_joint_gaussian(alone, record, delays):
    run, given = late_as(alone, Joint(PLANT | APART, record, delays=delays), record, delays)
    batch = alone.run_batch(np.stack([record[0]] * 9), record[1], given)
    np.testing.assert_array_equal(batch.innovation[8], run.innovation)
    for k in range(T):
        now = {name: float(np.broadcast_to(v, T)[k]) for name, v in given.items()}
        assert (
            alone.step(record[0][k], record[1][k], now).filtered_state == run.filtered_state[k]
        ).all()
    alone.reset()


@pytest.mark.parametrize("shared", [APART, SHARED], ids=["replayed", "remembered"])
def test_a_prediction_in_place_of_a_sample_keeps_the_past(shared, record, delays):
    filter_ = built("hind_passing", shared, delays=(3, 2))
    y, u, params = record
    y, gaps = y.copy(), {3, 4, 9, 15, 16, 17}
    y[sorted(gaps)] = np.nan
    given = {f"delay_{n}": delays[:, i] * 1.0 for i, n in enumerate(("gps", "wheel"))} | params
    given = {name: v for name, v in given.items() if name in dict(filter_.layout.parameters)}
    run = filter_.run(y, u, given)
    for k in range(T):
        now = u[k], {name: float(np.broadcast_to(v, T)[k]) for name, v in given.items()}
        if k in gaps:
            filter_.predict(*now)
        elif k % 2:
            filter_.update(y[k], *now)
            filter_.predict(*now)
        else:
            assert (filter_.step(y[k], *now).filtered_state == run.filtered_state[k]).all()


def test_only_a_row_that_may_be_late_can_be(record, delays):
    filter_ = built("hind_told", APART, "genie", SENSOR, delays=(3, 0))
    only = delays * [1, 0]
    late_as(filter_, Joint(PLANT | APART, record, told=True, delays=only), record, only)
    assert "delay_wheel" not in dict(filter_.layout.parameters)


def test_without_delays_it_is_the_filter_without_them(alone, record):
    y, u, params = record
    plain = built("hind_plain", APART)
    one, other = (each.run(y, u, {"dt": params["dt"]}) for each in (alone, plain))
    for port in plain.ports:
        np.testing.assert_allclose(one[port], other[port], rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(one.status, other.status)
    extra = sum(p.size for p in alone.layout.ports) - sum(p.size for p in plain.layout.ports)
    rows_and_parameters = 4 * (2 * 2 + 1 + 1) + 2 + 3
    assert extra - rows_and_parameters <= (3 + 2) * 2 * 3


def test_a_row_from_before_sample_0_is_missing(alone, record):
    y, u, params = record
    late = np.zeros(T)
    late[:3] = 3.0
    run = alone.run(y, u, {"dt": params["dt"], "delay_gps": late, "delay_wheel": late * 2 / 3})
    missing = y.copy()
    missing[:3, 0] = missing[:2, 1] = np.nan
    fewer = np.where(np.arange(T) == 2, 2.0, 0.0)
    other = alone.run(missing, u, {"dt": params["dt"], "delay_wheel": fewer})
    for port in other.ports:
        np.testing.assert_array_equal(run[port], other[port])
    assert run.status[0] == 1


def test_a_delay_that_is_none_refuses_its_row_and_a_missing_one_holds_the_sample(alone, record):
    y, u, params = np.nan_to_num(record[0], nan=1.0), record[1], record[2]
    wrong = np.zeros(T)
    wrong[[2, 4, 6, 7]] = 0.5, 4.0, -1.0, np.nan
    run = alone.run(y, u, {"dt": params["dt"], "delay_gps": wrong})
    assert run.status[[2, 4, 6, 7]].tolist() == [-4] * 4
    assert np.flatnonzero(run.held).tolist() == [7]
    missing = y.copy()
    missing[[2, 4, 6]] = np.nan
    left = np.delete(np.arange(T), 7)
    other = alone.run(missing[left], u[left], {"dt": params["dt"][left]})
    np.testing.assert_array_equal(run.filtered_state[left], other.filtered_state)


def sample_by_sample(record, delays):
    y, u, params = record
    given = {"dt": params["dt"], "delay_gps": delays[:, 0] * 1.0, "delay_wheel": delays[:, 1] * 1.0}
    return y, u, given


def test_a_selection_of_ports_keeps_what_late_rows_need(alone, record, delays):
    few = built("hind_few", APART, delays=(3, 2), code={"ports": ["filtered_state"]})
    given = sample_by_sample(record, delays)
    expected = alone.run(*given).filtered_state
    # Without S as a port innovations are corrected another way: roundings of numbers near 1.
    np.testing.assert_allclose(few.run(*given).filtered_state, expected, rtol=0, atol=1e-14)


def test_late_rows_in_c_have_the_bits_of_the_interpreter(alone, record, delays):
    y, u, given = sample_by_sample(record, delays)
    spec = fkgen.Spec.from_dict(table("hind_alone", APART, delays=(3, 2)))
    compiled, expected = alone.run(y, u, given), interpreted(spec, y, u, given)
    assert set(compiled.ports) <= set(expected)
    for port in compiled.ports:
        if port == "log_likelihood":  # C has a logarithm of its own
            np.testing.assert_allclose(compiled[port], expected[port], rtol=1e-14, atol=1e-14)
        else:
            np.testing.assert_array_equal(compiled[port], expected[port], err_msg=port)


def test_a_refused_sample_leaves_all_that_is_kept_for_late_rows(alone, record, delays):
    y, u, given = sample_by_sample(record, delays)
    y = np.nan_to_num(y, nan=1.0)
    own = {"dt": 0.1, "delay_gps": 2.0, "delay_wheel": 1.0}
    refused = {
        "an infinite input": ([np.inf], own),
        "a delay between samples": ([0.0], own | {"delay_gps": 0.5}),
        "a delay that is too long": ([0.0], own | {"delay_wheel": 3.0}),
    }
    alone.reset()
    for k in range(10):
        alone.step(y[k], u[k], {name: float(v[k]) for name, v in given.items()})
        before = alone.snapshot().data
        for what, (inputs, params) in refused.items():
            with pytest.raises(StepRefused):
                alone.update(y[k], np.array(inputs), params)
            assert alone.snapshot().data == before, what
    alone.reset()


def test_the_header_says_what_late_rows_cost(alone):
    header = (alone.folder / "hind_alone.h").read_text(encoding="utf-8")
    assert "Late rows of y: predictions and rows of the last 3 samples are kept" in header
    assert "a whole number, 0..3: so many samples ago was gps" in header


def test_what_cannot_be_late_is_refused_in_one_line():
    late = [{"name": "gps", "max_delay": 2}, {"name": "wheel"}]
    base = {"name": "hind_bad", "model": PLANT | {"outputs": late}, "parameters": DT}
    cases = {
        "parameters.delay_gps": base | {"parameters": DT | {"delay_gps": 0.0}},
        r"model.outputs\[0\].max_delay.*mme.*one of kf, ekf, mkf, genie": base
        | {"filter": {"family": "mme", "hypotheses": [0.5, 1.0]}, "faults": {"actuator": {}}},
        r"max_delay.*1.5.*whole number": base
        | {"model": PLANT | {"outputs": [{"name": "gps", "max_delay": 1.5}, {"name": "wheel"}]}},
        "max_delay.*filter.lag.*one of the two": base | {"filter": {"family": "kf", "lag": 2}},
        r"filter.lag.*0.*whole number": base | {"filter": {"family": "kf", "lag": 0}},
        r"filter.lag.*lag for the family iekf.*kf, ekf, mkf, genie": base
        | {"filter": {"family": "iekf", "lag": 2}},
    }
    for message, table in cases.items():
        with pytest.raises(fkgen.SpecError, match=message):
            fkgen.Spec.from_dict({"filter": {"family": "kf"}} | table)


def test_a_late_row_of_a_curved_plant_is_that_of_its_sample():
    """h is linearised where the filter was: near what a filter finds that had the row in time."""
    outputs = [CURVED["outputs"][0] | {"max_delay": 3}, CURVED["outputs"][1] | {"max_delay": 3}]
    model = CURVED | {"outputs": outputs, "P0": (0.01 * np.eye(3)).tolist()}
    table = {"name": "hind_late_ekf", "model": model, "filter": {"family": "ekf"}}
    late = fkgen.build(fkgen.Spec.from_dict(table))
    y = np.full((6, 2), np.nan)
    y[2] = np.hypot(5.25, 5.0), np.arctan2(5.0, 5.25)
    u = np.full((6, 1), 1.0)
    in_time = late.run(y, u)
    y[5], y[2] = y[2], np.nan
    given = {f"delay_{name}": [0, 0, 0, 0, 0, 3.0] for name in ("range", "bearing")}
    run, fresh = late.run(y, u, given), late.run(y, u)
    np.testing.assert_allclose(run.filtered_state[5], in_time.filtered_state[5], atol=1e-4)
    assert np.abs(fresh.filtered_state[5] - in_time.filtered_state[5]).max() > 1e-2


def test_an_attitude_about_one_axis_is_smoothed_as_its_angle_and_the_others_turn_with_it():
    """Nothing is learnt of the other two, so they keep their variances but for Jr of the turn."""
    model = {
        "states": [{"name": "q", "manifold": "SO3"}],
        "inputs": [{"name": "turn"}],
        "f": {"q": "q * [0.0, 0.0, turn]"},
        "h": ["2.0*atan2(q[3], q[0])"],
        "Q": np.diag([0.0, 0.0, 0.02]).tolist(),
        "R": [[0.1]],
        "x0": [1.0, 0.0, 0.0, 0.0],
        "P0": np.diag([0.3, 0.01, 0.4]).tolist(),
    }
    angle = {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Q": [[0.02]], "R": [[0.1]]}
    angle |= {"x0": [0.0], "P0": [[0.4]]}
    y = np.random.default_rng(8).normal(size=(12, 1)) * 0.8
    u = np.full((12, 1), 0.05)
    turning, plain = (
        fkgen.build(
            fkgen.Spec.from_dict(
                {"name": f"hind_{family}_axis", "model": each, "filter": {"family": family}}
            )
        )
        for each, family in ((model, "ekf"), (angle, "kf"))
    )
    found, expected, run = turning.smooth(y, u), plain.smooth(y, u), turning.run(y, u)
    angles = [
        2.0 * np.arctan2(each[:, 3], each[:, 0]) for each in (found.state, run.filtered_state)
    ]
    close(
        (angles[0], found.covariance[:, 2, 2]), (expected.state[:, 0], expected.covariance.ravel())
    )
    for k, d in enumerate(angles[0] - angles[1]):
        if abs(d) > 1e-3:
            side = (1.0 - np.cos(d)) / d
            J = np.array([[np.sin(d) / d, side], [-side, np.sin(d) / d]])
            tilt = J @ run.filtered_covariance[k, :2, :2] @ J.T
            np.testing.assert_allclose(found.covariance[k, :2, :2], tilt, rtol=LEVEL, atol=1e-12)
    assert np.abs(angles[0] - angles[1]).max() > 0.1
