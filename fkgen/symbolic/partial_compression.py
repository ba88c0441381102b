"""The correlated partial error-state compression filter: Lee & Lee, Theorem 4.

Within a sample, in the order in which nothing is used twice: host update with its rows, maintenance
of Z, then compression of the other rows with the a posteriori host; at the end of a window the host
takes Z over, unless the test rejects it, and Z is discarded.
"""

from __future__ import annotations

from functools import partial

from fkgen.errors import InternalError
from fkgen.spec import Spec
from fkgen.symbolic.estimate import bound, finite, update_form
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linalg import congruence, pack
from fkgen.symbolic.partial_closing import closing
from fkgen.symbolic.partial_state import Compressed, PartialFilter, partial_state, parts
from fkgen.symbolic.partial_update import update
from fkgen.symbolic.plant import plant_of
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.window import (
    count_down,
    of_the_host,
    window_outcomes,
    window_ports,
    window_start,
)


def partial_compression_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``cpcf``."""
    faults, plant = spec.faults.soft, plant_of(spec)
    if faults is None:
        raise InternalError(f"{spec.filter.family} without soft faults")
    ports = (
        *state_ports(spec),
        *of_the_host(innovation_ports(spec)),
        *window_ports(spec, faults),
        *_compressed_ports(plant.nx, len(faults.compressed)),
    )
    given = PartialFilter(
        spec=spec,
        faults=faults,
        plant=plant,
        symbols=symbols_of(spec, plant, ports),
        form=update_form(spec, plant, augmented=False),
        partial=partial_state(spec, plant, faults.compressed),
    )
    start = dict(zip(("state", "covariance"), prior_of(spec), strict=True))
    initial = {f"{of}_{what}": v for what, v in start.items() for of in ("predicted", "filtered")}
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial=initial | window_start(faults),
        update=update(given),
        closing=closing(given),
        predict=_predict(given),
        notes=(
            f"covariance update: {given.form} form",
            f"maintenance of the compressed measurement: {spec.filter.maintenance}",
        ),
        outcomes=window_outcomes(spec),
    )


def _compressed_ports(n: int, m: int) -> tuple[Port, ...]:
    """Z, R and S after sample k and before sample k + 1."""
    port = partial(Port, role=Role.STATE)
    result: list[Port] = []
    for prefix, when in (("", ""), ("predicted_", " before sample k+1")):
        result += [
            port(
                name=f"{prefix}compressed_measurement",
                shape=(m,),
                meaning=f"Z = T1 e + V{when}, e = x minus the estimate of the host; 0 without one",
            ),
            port(
                name=f"{prefix}compressed_noise",
                shape=(m, m),
                symmetric=True,
                meaning=f"R: covariance of V{when}",
            ),
            port(
                name=f"{prefix}compressed_cross_covariance",
                shape=(m, n),
                meaning=f"S: covariance of V with e{when}",
            ),
        ]
    return tuple(result)


def _predict(given: PartialFilter) -> Phase:
    script, symbols = Script(given.symbols), given.symbols
    plant, n = bound(script, given.plant, "ABQ"), given.plant.nx
    carried, partial = given.compressed(), given.partial
    state = plant.A @ symbols["filtered_state"] + plant.B @ symbols["u"]
    joint = carried.joint(symbols["filtered_covariance"])
    moved = congruence(partial.transition(plant), joint) + pack(partial.noise(plant))
    covariance, cross, noise = parts(moved, n, partial.size)
    counted = count_down(script, symbols, given.faults)
    after = Compressed(partial.advance(plant) @ carried.measurement, noise, cross)
    with script.titled("prediction of the next sample"):
        script.put(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                **after.ports("predicted_"),
                **counted,
            },
            [finite(state, covariance), finite(after.measurement, after.noise)],
        )
    return script.phase()
