"""Random plants by equations, and specs of every family that linearises them.

What is drawn: polynomials, waves, tables and decisions in f and h, angles that wrap in x and y,
noises through f, continuous time, y that depends on u, an attitude beside other states.
"""

from __future__ import annotations

import equations
import numpy as np
from plants import covariance

from fkgen.oracle.claims.claim import Record
from fkgen.oracle.sampled import draw_record

TABLES = {"curve": {"x": [-2.0, -0.5, 0.4, 1.5], "y": [-1.0, 0.3, 0.1, 0.8], "kind": "pchip"}}
#: Functions of two states, of one input and of one noise.
MIXED = (
    "0.3*sin({0}) + 0.2*{1}", "0.2*{0}*cos({1})", "tanh({0} - 0.5*{1})",
    "0.4*{0}**2/(2 + {0}**2) - 0.1*{1}",
    "interp({0}, 'curve') + 0.1*{1}", "if({0} > 0.2, 0.3*{0}, 0.1*{0} + 0.04) - 0.1*{1}",
    "0.2*gain*atan2({0} + 3, {1} + 4)", "0.3*hypot({0} - 2, {1} + 3)", "0.2*exp(-{0}**2)*{1}",
)  # fmt: skip
DRIVEN = ("0.4*{u}", "0.3*{u}*cos({0})", "0.2*sin({u} + {0})", "0.3*gain*{u}*{0}")
SHAKEN = ("{w}", "{w}*(1 + 0.3*sin({0}))", "0.5*{w}*{0}", "tanh({w})")


def model(rng, *, attitude=False, inputs=1, outputs=2, shift="0"):
    """The model of a spec; ``shift`` is added to what y says of an input."""
    lines = int(rng.integers(1, 3)) if attitude else int(rng.integers(2, 4))
    names, u = [f"s{i}" for i in range(lines)], [f"u{i}" for i in range(inputs)]
    continuous, wrapped = rng.random() < 0.4, rng.random(lines) < 0.3
    seen = [*names, *(f"a[{i}]" for i in range(3))] if attitude else names
    states = [
        {"name": name} | ({"unit": "rad", "wrap": True} if wraps else {})
        for name, wraps in zip(names, wrapped, strict=True)
    ]
    f = {
        name: f"{'-0.9' if continuous else '0.6'}*{name} + {_term(rng, seen, u, ('w0', 'w1'))}"
        for name in names
    }
    if attitude:
        states.insert(1, {"name": "q", "manifold": "SO3"})
        rate = f"[0.2 + 0.3*{u[0]}, 0.3*{names[0]} + 0.2*w0, 0.1*{u[-1]} - 0.2]"
        f["q"] = rate if continuous else f"q * ({rate} * 0.5)"
    h = {}
    for i in range(outputs):
        i_th = f"{seen[-1 - i % len(seen)]} + {_term(rng, seen, u if shift != '0' else ())}"
        h[f"y{i}"] = i_th + (f" + {shift}*{u[i % inputs]}" if shift != "0" else "")
    time = {"time": "continuous", "sample_time": "dt", "substeps": int(rng.integers(1, 3))}
    time["integrator"] = str(rng.choice(["rk4", "euler"]))
    x0 = list(0.5 * rng.standard_normal(lines))
    if attitude:
        q = rng.standard_normal(4)
        x0[1:1] = list(q / np.linalg.norm(q))
    ne = lines + 3 * attitude
    R = covariance(rng, outputs) if rng.random() < 0.5 else np.diag(rng.uniform(0.2, 1.0, outputs))
    return {
        "states": states, "inputs": [{"name": name} for name in u],
        "outputs": [
            {"name": name} | ({"unit": "rad", "wrap": True} if rng.random() < 0.3 else {})
            for name in h
        ],
        "noises": [{"name": "w0", "variance": "0.1*gain"}, {"name": "w1", "variance": 0.05}],
        "let": {"a": "rotate_back(q, [0.5, -0.3, 1.2])"} if attitude else {},
        "f": f, "h": h, "Q": (0.05 * covariance(rng, ne)).tolist(), "R": (0.2 * R).tolist(),
        "x0": x0, "P0": (0.3 * covariance(rng, ne)).tolist(),
    } | (time if continuous else {})  # fmt: skip


def _term(rng, seen, inputs, noises=()):
    """A function of two of the names, of an input and of a noise where there are any."""
    first, second = rng.choice(seen, 2)
    text = str(rng.choice(MIXED)).format(first, second)
    if inputs:
        text += " + " + str(rng.choice(DRIVEN)).format(first, u=rng.choice(list(inputs)))
    if noises:
        text += " + " + str(rng.choice(SHAKEN)).format(second, w=rng.choice(list(noises)))
    return text


def _actuator(rates, *, dependence="independent", options=None):
    def sections(_, __):
        faults = {"dependence": dependence} | ({} if rates is None else {"success_rate": rates})
        return {"faults": {"actuator": faults}, "filter": options or {}}

    return sections


def _sensor(law, **options):
    def sections(rng, _):
        kernel = rng.dirichlet(np.ones(4), 4).tolist()
        laws = {
            "kernel": {"problem": 4, "kernel": kernel, "initial": kernel[0]},
            "joint": {"problem": 2, "joint": ["0.4*gain", "0.6 - 0.4*gain", 0.3, 0.1]},
            "told": {},
        }
        faults = {"noise_factor": "4 + gain", "rows": [0]} | laws[law]
        return {"faults": {"sensor": faults}, "filter": options}

    return sections


def _jump(rng, plant):
    """Modes that state a part of f, of h, a definition, Q or R of their own."""
    some, row = next(iter(plant["f"])), next(iter(plant["h"]))
    modes = [
        {},
        {"f": {some: f"{plant['f'][some]} + 0.3"}, "Q": (2.0 * np.array(plant["Q"])).tolist()},
        {"h": {row: f"0.5*({plant['h'][row]})"}, "R": (3.0 * np.array(plant["R"])).tolist()},
    ]
    law = rng.dirichlet(np.ones(3), 3)
    transition = [law[0].tolist(), law[1].tolist(), ["0.3*gain", "0.7 - 0.3*gain", 0.3]]
    jump = {"modes": modes, "transition": transition, "initial": law[2].tolist()}
    return {"faults": {"jump": jump}, "filter": {}}


#: Family, what the plant has, and sections that say what fails.
CASES = {
    "ekf": ("ekf", {}, lambda *_: {}),
    "ekf_attitude": ("ekf", {"attitude": True, "outputs": 3}, lambda *_: {}),
    "mkf": ("mkf", {"inputs": 2}, _actuator([0.7, "0.5*gain"])),
    "mkf_sensed": ("mkf", {"inputs": 2, "shift": "0.7"}, _actuator([0.7, 0.4])),
    "mkf_attitude": (
        "mkf", {"attitude": True, "inputs": 2, "shift": "0.7"},
        _actuator(0.6, dependence="common"),
    ),
    "mme": ("mme", {}, _actuator(None, options={"hypotheses": [0.2, 0.9]})),
    "mme_sensed": (
        "mme", {"inputs": 2, "shift": "0.7"},
        _actuator(None, options={"hypotheses": [[0.2, 1.0], [0.6, 0.5]]}),
    ),
    "mme_attitude": (
        "mme", {"attitude": True}, _actuator(None, options={"hypotheses": [0.1, 0.5, 1.0]})
    ),
    "imm": ("imm", {}, _sensor("kernel")),
    "imm_three": ("imm", {}, _sensor("kernel", modes=3)),
    "imm_jump": ("imm", {}, _jump),
    "imm_attitude": ("imm", {"attitude": True}, _jump),
    "imm_attitude_three": ("imm", {"attitude": True}, _sensor("kernel", modes=3)),
    "one_step": ("one_step", {}, _sensor("joint")),
    "one_step_weighted": ("one_step", {}, _sensor("kernel", covariance="weighted")),
    "one_step_attitude": ("one_step", {"attitude": True}, _sensor("kernel")),
    "one_step_attitude_paper": (
        "one_step", {"attitude": True}, _sensor("kernel", covariance="paper")
    ),
    "genie": ("genie", {}, _sensor("told")),
    "genie_attitude": ("genie", {"attitude": True}, _sensor("told")),
}  # fmt: skip


def spec(case, seed=0, scalar="double", **changed):
    """A spec of a case, with what is changed of its model."""
    import fkgen

    family, has, sections = CASES[case]
    rng = np.random.default_rng([seed, list(CASES).index(case)])
    plant = model(rng, **has) | changed
    said = {"filter": {}} | sections(rng, plant)
    said["filter"] = {"family": family} | said["filter"]
    given = {"dt": 0.3, "gain": {"default": 0.8, "min": 0.1, "max": 1.2}}
    return fkgen.Spec.from_dict(
        equations.table(plant, given, tables=TABLES, code={"scalar": scalar}, **said)
    )


def record(plant, T=8, seed=1):
    """A record of the plant itself, rows of it missing, with parameters that change."""
    rng = np.random.default_rng(seed)
    now = {name: value * rng.uniform(0.9, 1.1, T) for name, value in plant.defaults.items()}
    parameters = {item.name: now[item.name] for item in plant.stated_parameters}
    u = rng.standard_normal((T, plant.model.nu))
    y, told = draw_record(plant, parameters, u, rng)
    y[rng.random(y.shape) < 0.2] = np.nan
    y[3] = np.nan
    return Record(y=y, u=u, parameters=told, P0=plant.model.P0.values())
