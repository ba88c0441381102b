"""What the XML files of a co-simulation unit say, in versions 2 and 3 of FMI.

References
----------
Functional Mock-up Interface for Model Exchange and Co-Simulation, version 2.0.4.
Functional Mock-up Interface Specification, version 3.0.2.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from fkgen.backend.ir import CProgram, Signal
from fkgen.symbolic.interface import Port, triangle
from fkgen.version import __version__

#: Elements of variables in version 3, by those of version 2.
_KINDS = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean"}


@dataclass(frozen=True, slots=True)
class Variable:
    """What the unit is given, or gives."""

    name: str
    kind: str  # as in version 2: Real, Integer or Boolean
    causality: str
    variability: str
    meaning: str
    unit: str = ""
    start: str = ""


def token_of(program: CProgram) -> str:
    """What a tool has to present: the model that the description is of."""
    return f"{{{uuid.uuid5(uuid.NAMESPACE_OID, f'fkgen {__version__} {program.digest}')}}}"


def variables(program: CProgram) -> list[Variable]:
    """All there are, in the order of their references."""
    found: list[Variable] = []
    taken = {*(port.name for port in program.ports), "status", "held", "time"}

    def free(prefix: str, name: str) -> str:
        own = f"{prefix}.{name}" if name in taken else name
        taken.add(own)
        return own

    for letter, what, signals in (
        ("u", "input", program.inputs),
        ("y", "measurement; NaN where it is missing", program.outputs),
    ):
        for each in signals:
            name = free(letter, each.name)
            found.append(Variable(name, "Real", "input", "discrete", what, each.unit, "0"))
    for name, default in program.parameters:
        own, what = free("params", name), "run-time parameter"
        found.append(Variable(own, "Real", "parameter", "tunable", what, start=repr(default)))
    for port in program.ports:
        for place, unit in _places(program, port):
            named = f"{port.name}{place}"
            found.append(Variable(named, "Real", "output", "discrete", port.meaning, unit))
    meaning = "0 used, 1 no row, 2 and 3 rejected, negative refused"
    found.append(Variable("status", "Integer", "output", "discrete", meaning))
    meaning = "the sample was refused even as a missing one"
    found.append(Variable("held", "Boolean", "output", "discrete", meaning))
    return [*found, Variable("time", "Real", "independent", "continuous", "end of the step")]


def _places(program: CProgram, port: Port) -> Iterator[tuple[str, str]]:
    """How the numbers of a port are told apart, as they are stored, and their units."""
    names: dict[str, tuple[Signal, ...]] = {"x": program.states, "y": program.outputs}
    signals = names.get(port.unit, program.outputs if port.flags else ())
    if len(port.shape) == 1 and len(signals) == port.shape[0]:
        yield from ((f".{each.name}", "" if port.flags else each.unit) for each in signals)
    elif not port.shape:
        yield "", ""
    elif port.symmetric:
        pairs = triangle(port.shape[-1])
        for stacked in np.ndindex(port.shape[:-2]):
            yield from ((f"[{','.join(map(str, (*stacked, *pair)))}]", "") for pair in pairs)
    else:
        yield from ((f"[{','.join(map(str, place))}]", "") for place in np.ndindex(port.shape))


def description(program: CProgram, version: int, listed: list[str]) -> bytes:
    """modelDescription.xml; ``listed`` are the sources to compile."""
    every = variables(program)
    root = ET.Element(
        "fmiModelDescription",
        {"fmiVersion": f"{version}.0", "modelName": program.name},
        description=f"{program.family} filter by fkgen; one step is one sample",
        generationTool=f"fkgen {__version__}",
        variableNamingConvention="structured",
    )
    root.set("guid" if version == 2 else "instantiationToken", token_of(program))
    state = "state" if version == 2 else "State"
    unit = ET.SubElement(
        root,
        "CoSimulation",
        {f"canGetAndSetFMU{state}": "true", f"canSerializeFMU{state}": "true"},
        modelIdentifier=program.name,
        canHandleVariableCommunicationStepSize="true",
        canBeInstantiatedOnlyOncePerProcess="false",
    )
    if version == 2:
        files = ET.SubElement(unit, "SourceFiles")
        for name in listed:
            ET.SubElement(files, "File", name=name)
    if units := sorted({each.unit for each in every if each.unit}):
        defined = ET.SubElement(root, "UnitDefinitions")
        for named in units:
            ET.SubElement(defined, "Unit", name=named)
    step = program.sample_time
    size = step if isinstance(step, float) else dict(program.parameters).get(str(step), 1.0)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(float(size)))
    listing = ET.SubElement(root, "ModelVariables")
    for reference, each in enumerate(every):
        _variable(listing, version, reference, each)
    _structure(root, version, every)
    return _written(root)


def build_description(program: CProgram, listed: list[str]) -> bytes:
    """sources/buildDescription.xml of version 3: what to compile, and as what."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    built = ET.SubElement(root, "BuildConfiguration", modelIdentifier=program.name)
    files = ET.SubElement(built, "SourceFileSet", language="C99")
    for name in listed:
        ET.SubElement(files, "SourceFile", name=name)
    return _written(root)


def _written(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def _variable(listing: ET.Element, version: int, reference: int, each: Variable) -> None:
    about = {
        "name": each.name,
        "valueReference": str(reference),
        "description": each.meaning,
        "causality": each.causality,
        "variability": each.variability,
    }
    about |= {"initial": "calculated"} if each.causality == "output" else {}
    typed = {"unit": each.unit} if each.unit else {}
    typed |= {"start": each.start} if each.start else {}
    if version == 2:
        ET.SubElement(ET.SubElement(listing, "ScalarVariable", about), each.kind, typed)
    else:
        ET.SubElement(listing, _KINDS[each.kind], about | typed)


def _structure(root: ET.Element, version: int, every: list[Variable]) -> None:
    """The outputs; in version 2 by their places from one, in version 3 by their references."""
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [i for i, each in enumerate(every) if each.causality == "output"]
    if version == 2:
        for name in ("Outputs", "InitialUnknowns"):
            unknowns = ET.SubElement(structure, name)
            for i in outputs:
                ET.SubElement(unknowns, "Unknown", index=str(i + 1))
    else:
        for name in ("Output", "InitialUnknown"):
            for i in outputs:
                ET.SubElement(structure, name, valueReference=str(i))
