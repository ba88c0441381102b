"""A filter as a co-simulation unit of FMI 2.0: XML, sources and a library for this machine, zipped.

References
----------
Functional Mock-up Interface for Model Exchange and Co-Simulation, version 2.0.4.
"""

from __future__ import annotations

import io
import platform
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from fkgen.backend.ir import CProgram, Signal
from fkgen.backend.lines import filled
from fkgen.backend.render import context_of
from fkgen.backend.source import Source
from fkgen.runtime.compiler import compile_shared, find_compiler
from fkgen.symbolic.interface import Port, triangle
from fkgen.version import __version__

#: A year in which every file of the archive is written: the same spec gives the same bytes.
_TIME = (1980, 1, 1, 0, 0, 0)

#: Folders of binaries by system and machine; those that version 2 does not name are as in 3.
_PLATFORMS = {
    ("Linux", "x86_64"): "linux64",
    ("Darwin", "x86_64"): "darwin64",
    ("Windows", "AMD64"): "win64",
}
_ENDINGS = {"Darwin": ".dylib", "Windows": ".dll"}

_REFERENCES = ("fmi2Component c", "const fmi2ValueReference vr[]", "size_t count")
_MORE = ("const fmi2ValueReference vr[]", "size_t count", "const fmi2Integer order[]")
_KIND = ("fmi2Component c", "const fmi2StatusKind kind")
#: Functions for what the unit has none of: texts, derivatives of inputs, asynchronous steps.
_ABSENT = (
    ("fmi2GetString", *_REFERENCES, "fmi2String value[]"),
    ("fmi2SetInteger", *_REFERENCES, "const fmi2Integer value[]"),
    ("fmi2SetBoolean", *_REFERENCES, "const fmi2Boolean value[]"),
    ("fmi2SetString", *_REFERENCES, "const fmi2String value[]"),
    ("fmi2SetRealInputDerivatives", "fmi2Component c", *_MORE, "const fmi2Real value[]"),
    ("fmi2GetRealOutputDerivatives", "fmi2Component c", *_MORE, "fmi2Real value[]"),
    (
        "fmi2GetDirectionalDerivative",
        *("fmi2Component c", "const fmi2ValueReference unknown[]", "size_t unknowns"),
        *("const fmi2ValueReference known[]", "size_t knowns"),
        *("const fmi2Real seed[]", "fmi2Real value[]"),
    ),
    ("fmi2GetStatus", *_KIND, "fmi2Status *value"),
    ("fmi2GetRealStatus", *_KIND, "fmi2Real *value"),
    ("fmi2GetIntegerStatus", *_KIND, "fmi2Integer *value"),
    ("fmi2GetBooleanStatus", *_KIND, "fmi2Boolean *value"),
    ("fmi2GetStringStatus", *_KIND, "fmi2String *value"),
)


@dataclass(frozen=True, slots=True)
class Variable:
    """What the unit is given, or gives."""

    name: str
    kind: str  # Real, Integer or Boolean
    causality: str
    variability: str
    meaning: str
    unit: str = ""
    start: str = ""


def fmu(source: Source) -> bytes:
    """The unit of a filter, whose library is for this machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or if it refuses the sources.
    """
    program = source.program
    context = context_of(program) | {"guid": _guid(program), "absent_functions": _ABSENT}
    sources = {name: text for name, text in source.files.items() if _is_source(program, name)}
    sources["fmi2.c"] = filled("fmi2.c.j2", context)
    listed = sorted(name for name in sources if name.endswith(".c"))
    files = {f"sources/{name}": text.encode("utf-8") for name, text in sources.items()}
    files["modelDescription.xml"] = _description(program, listed)
    where, library = _binary(program, sources, listed)
    files[where] = library
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name in sorted(files):
            zipped.writestr(zipfile.ZipInfo(name, _TIME), files[name], zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _is_source(program: CProgram, name: str) -> bool:
    return name.endswith((".c", ".h")) and not name.startswith(f"{program.name}_selftest")


def _guid(program: CProgram) -> str:
    return f"{{{uuid.uuid5(uuid.NAMESPACE_OID, f'fkgen {__version__} {program.digest}')}}}"


def _binary(program: CProgram, sources: dict[str, str], listed: list[str]) -> tuple[str, bytes]:
    """Where the library belongs, and what is in it."""
    system, machine = platform.system(), platform.machine()
    place = _PLATFORMS.get((system, machine), f"{machine}-{system.lower()}")
    name = f"{program.name}{_ENDINGS.get(system, '.so')}"
    with tempfile.TemporaryDirectory(prefix="fkgen-") as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        whole, library = Path(folder) / "whole.c", Path(folder) / name
        whole.write_text("".join(f'#include "{each}"\n' for each in listed), encoding="utf-8")
        statements = program.statements
        compile_shared(find_compiler(), whole, library, statements=statements, native=False)
        return f"binaries/{place}/{name}", library.read_bytes()


def variables(program: CProgram) -> list[Variable]:
    """All there are, in the order of their references."""
    found: list[Variable] = []
    taken = {*(port.name for port in program.ports), "status", "held"}

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
    return [*found, Variable("held", "Boolean", "output", "discrete", meaning)]


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


def _description(program: CProgram, listed: list[str]) -> bytes:
    """modelDescription.xml."""
    every = variables(program)
    step = program.sample_time
    size = step if isinstance(step, float) else dict(program.parameters).get(str(step), 1.0)
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=program.name,
        guid=_guid(program),
        description=f"{program.family} filter by fkgen; one step is one sample",
        generationTool=f"fkgen {__version__}",
        variableNamingConvention="structured",
    )
    unit = ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=program.name,
        canHandleVariableCommunicationStepSize="true",
        canBeInstantiatedOnlyOncePerProcess="false",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    files = ET.SubElement(unit, "SourceFiles")
    for name in listed:
        ET.SubElement(files, "File", name=name)
    units = sorted({each.unit for each in every if each.unit})
    if units:
        defined = ET.SubElement(root, "UnitDefinitions")
        for named in units:
            ET.SubElement(defined, "Unit", name=named)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(float(size)))
    listing = ET.SubElement(root, "ModelVariables")
    for reference, each in enumerate(every):
        _variable(listing, reference, each)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [i for i, each in enumerate(every, 1) if each.causality == "output"]
    for name in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(structure, name)
        for i in outputs:
            ET.SubElement(unknowns, "Unknown", index=str(i))
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def _variable(listing: ET.Element, reference: int, each: Variable) -> None:
    variable = ET.SubElement(
        listing,
        "ScalarVariable",
        name=each.name,
        valueReference=str(reference),
        description=each.meaning,
        causality=each.causality,
        variability=each.variability,
    )
    if each.causality == "output":
        variable.set("initial", "calculated")
    about = {"unit": each.unit} if each.unit else {}
    about |= {"start": each.start} if each.start else {}
    ET.SubElement(variable, each.kind, about)
