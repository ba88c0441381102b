"""Kalman filter: the family without faults, and the yardstick of the others.

One step corrects the prediction for sample k with y[k] and predicts sample k + 1 (Anderson & Moore 1979,
sec. 3.1, eqs. (1.3)-(1.11)), with missing rows left out and time-varying models through parameters.
"""

from __future__ import annotations

from fkgen.families.family import Family
from fkgen.families.linear import BATCH, LIMIT
from fkgen.spec import Spec
from fkgen.symbolic.actuation import certain
from fkgen.symbolic.estimate import (
    bound,
    correct,
    demand_finite,
    demand_positive,
    propagate,
    update_form,
)
from fkgen.symbolic.plant import plant_of
from fkgen.symbolic.ports import innovation_ports, state_ports, symbols_of
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.script import Script
