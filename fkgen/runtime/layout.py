"""What Python needs to know of a compiled filter: enough to use it without building it again."""

from __future__ import annotations

import ctypes
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fkgen.backend.ir import CProgram
from fkgen.symbolic.interface import CORRELATED, MODEL, UPDATED, Port, Role


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Names, sizes and ports of a compiled filter."""

    name: str
    spec: str  # Digest of what the filter was built from
    family: str
    scalar: str
    states: tuple[str, ...]  # states, inputs, outputs: Names of the numbers in x, u and y
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    errors: tuple[str, ...]  # The same of the rows of covariances of x
    attitudes: tuple[int, ...]  # Where quaternions begin in x
    parameters: tuple[tuple[str, float], ...]  # Run-time parameters with their defaults
    ports: tuple[Port, ...]  # Members of the C instance, in order
    prior: tuple[tuple[float, ...], tuple[float, ...]]  # x0, and P0 packed, at the defaults
    own_prior: bool  # They depend on parameters, and C computes them
    groups: int  # Of rows with correlated noises, one more member for each
    flops: int  # Operations per step
    claims: tuple[str, ...]  # What was proved before the code was generated
    statements: int = 0  # Operations as they stand in the text, where loops repeat them

    @property
    def dtype(self) -> type[np.floating]:
        """The NumPy scalar."""
        return np.float64 if self.scalar == "double" else np.float32

    @property
    def real(self) -> Any:
        """The same in ctypes."""
        return ctypes.c_double if self.scalar == "double" else ctypes.c_float

    def dtype_of(self, port: Port) -> type[np.generic]:
        """The NumPy scalar of a port in Python."""
        return np.bool_ if port.flags else self.dtype

    def structure(self) -> type[ctypes.Structure]:
        """The C instance as a ctypes structure."""
        real = self.real
        fields = [(port.member, real * port.size if port.shape else real) for port in self.ports]
        fields.append((UPDATED, real))
        fields += [(CORRELATED, real * self.groups)] if self.groups else []
        words = -(-len(self.outputs) // 32)
        flags = [port.name for port in self.ports if port.flags]
        fields += [(name, ctypes.c_uint32 * words) for name in flags]
        fields.append((MODEL, ctypes.c_uint32))
        if self.scalar == "double" and words * len(flags) % 2 == 0:
            fields.append(("unused", ctypes.c_uint32))
        return type(f"{self.name}_t", (ctypes.Structure,), {"_fields_": fields})

    def to_json(self) -> str:
        """Text from which `from_json` makes an equal layout."""
        return json.dumps(asdict(self), indent=1, default=lambda role: role.value)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Read what `to_json` wrote."""
        facts: dict[str, Any] = json.loads(text)
        ports = tuple(
            Port(**{**port, "role": Role(port["role"]), "shape": tuple(port["shape"])})
            for port in facts.pop("ports")
        )
        x0, P0 = facts.pop("prior")
        parameters = tuple((name, value) for name, value in facts.pop("parameters"))
        rest: Any = {key: tuple(v) if isinstance(v, list) else v for key, v in facts.items()}
        prior = tuple(x0), tuple(P0)
        return cls(ports=ports, parameters=parameters, prior=prior, **rest)


def layout_of(program: CProgram, claims: tuple[str, ...]) -> Layout:
    """The layout of a program."""
    same: tuple[str, ...] = ("name", "family", "scalar", "parameters", "ports", "prior")
    same += ("attitudes", "flops", "statements")
    facts: dict[str, Any] = {key: getattr(program, key) for key in same}
    facts["spec"] = program.digest
    for key in ("states", "inputs", "outputs", "errors"):
        facts[key] = tuple(signal.name for signal in getattr(program, key))
    groups, own = len(program.repeats or ()), program.origin is not None
    return Layout(claims=claims, groups=groups, own_prior=own, **facts)
