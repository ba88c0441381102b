"""Profiles of faults for `fkgen.fault_effect`: pulse, step, ramp, drift, from_csv."""

from fkgen.study.effects.profiles import drift, from_csv, pulse, ramp, step

__all__ = ["drift", "from_csv", "pulse", "ramp", "step"]
