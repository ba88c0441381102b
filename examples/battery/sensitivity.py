"""Halve and double every number that was chosen: ``python sensitivity.py``.

Prints the last table of the page. One filter serves: what is varied is a parameter.
"""

from __future__ import annotations

from prepare import read
from run import content, errors, run

import fkgen

SEEDS = (1, 2, 3)
FACTORS = {
    "k_charge": "noise of the charge",
    "k_rc": "noise of v1",
    "k_current": "noise of the current",
    "k_resistance": "noise of r0",
    "k_sensor": "noise of the sensor",
    "k_meter": "noise of the voltage",
    "k_tau": "time constant",
    "k_r1": "resistance of the RC pair",
    "k_fails": "time between failures",
    "k_lasts": "length of a failure",
}


def varied() -> fkgen.Spec:
    """Make the spec with a factor for every number, 1 by default."""
    table, names = content(), list(FACTORS)
    model, sensor = table["model"], table["faults"]["sensor"]
    for i, name in enumerate(names[:6]):
        row = (model["Q"] + model["R"])[i]
        row[i % 4] = f"{name}**2*({row[i % 4]})"
    model["let"]["stays"] = "exp(-dt/(100*k_tau))"
    model["f"]["v1"] = "stays*v1 + 0.0015*k_r1*(1 - stays)*current"
    lost, back = "exp(-dt/(60*k_lasts))", "exp(-dt/(300*k_fails))"
    sensor["gamma_chain"] = [[lost, f"1 - {lost}"], [f"1 - {back}", back]]
    table["parameters"] |= dict.fromkeys(names, 1.0)
    return fkgen.Spec.from_dict(table, file="spec.toml")


def main() -> None:
    """Print the largest errors of three seeds."""
    record, compiled = read(), fkgen.build(varied())
    capacity = content()["parameters"]["capacity"]

    def largest(params: dict[str, float]) -> str:
        runs = [run(compiled, record, seed, params) for seed in SEEDS]
        return f"{max(errors(out.filtered_state[:, 0], record)[0] for out in runs):.2f} %"

    print("| scaled | halved | doubled |")
    print("| --- | ---: | ---: |")
    print(f"| nothing | {largest({})} | |")
    for name, label in FACTORS.items():
        print(f"| {label} | {largest({name: 0.5})} | {largest({name: 2.0})} |")
    cells = [largest({"capacity": factor * capacity}) for factor in (0.98, 1.02)]
    print("| capacity, by 2 % | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
