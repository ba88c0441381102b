"""Folders that build systems accept: CMake, Arduino, PlatformIO, Zephyr, ESP-IDF, CMSIS, MEX, C++.

One folder serves several of them. Sources are in ``src/``, an application in ``examples/``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from fkgen.backend.ir import Signal
from fkgen.backend.lines import LICENSE, SPDX, filled
from fkgen.backend.render import context_of
from fkgen.backend.source import LARGE_STATES, Source, write_package
from fkgen.errors import DataError, OutputError
from fkgen.problem import Spec
from fkgen.problem.table.place import Place
from fkgen.version import __version__

#: Where a filter in double compiles: on AVR double has 32 bits.
_WIDE = "esp32,esp8266,mbed,mbed_nano,mbed_rp2040,renesas_uno,rp2040,sam,samd,stm32,zephyr"
_XML = '<?xml version="1.0" encoding="UTF-8"?>'
_ARDUINO = 63  # characters that a name of its library manager has at most


@dataclass(frozen=True, slots=True)
class Packing:
    """What goes into a package, and what templates read."""

    spec: Spec
    source: Source
    kinds: tuple[str, ...]

    @property
    def name(self) -> str:
        """That of the filter."""
        return self.source.program.name

    @property
    def units(self) -> list[str]:
        """Sources of the library, in order."""
        names = (n for n in self.source.files if n.endswith(".c"))
        return sorted(f"src/{n}" for n in names if not n.startswith(f"{self.name}_selftest"))

    @property
    def description(self) -> str:
        """One sentence."""
        return self.spec.package.description or f"{self.spec.filter.family} filter {self.name}"

    @property
    def license(self) -> str:
        """That of the package: what the spec says, else that of generated files."""
        return self.spec.package.license or LICENSE

    def need(self, *keys: str, kind: str) -> None:
        """Refuse a spec without these texts about its package."""
        for key in keys:
            self.spec.package.require(key, kind, self.spec.file)

    def filled(self, template: str, **more: object) -> str:
        """A template of packages."""
        program, headers = self.source.program, ["hpp"] if "cpp" in self.kinds else []
        shared = [f"src/{n}" for n in self.source.files if n.endswith(".h")]
        context = context_of(program) | {
            "about": self.spec.package,
            "kinds": self.kinds,
            "units": self.units,
            "large": len(program.states) >= LARGE_STATES,
            "headers": sorted({*shared, *(f"src/{self.name}.{end}" for end in headers)}),
            "inner": {
                "u": _inside(program.inputs, program.scalar),
                "y": _inside(program.outputs, program.scalar),
            },
        }
        return filled(f"package/{template}.j2", context | more)


def _inside(signals: Sequence[Signal], scalar: str) -> list[str]:
    """A number within the range of each signal, 0 if that is one."""
    found = [0.0 if s.range is None else min(max(0.0, s.range[0]), s.range[1]) for s in signals]
    return [f"{value!r}{'f' if scalar == 'float' else ''}" for value in found]


def listed(text: str) -> list[str]:
    """Kinds with commas between them."""
    return [kind.strip() for kind in text.split(",")]


def packaged(spec: Spec, source: Source, kinds: Sequence[str]) -> dict[str, str]:
    """Texts of a package by their names in its folder.

    Raises
    ------
    DataError
        If a kind is not known.
    SpecError
        If ``[package]`` lacks what one of them needs, or a name may not be one there.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise DataError("package", given=repr(kind), expected=f"one of {', '.join(KINDS)}")
    packing = Packing(spec, source, tuple(dict.fromkeys(kinds)))
    files: dict[str, str] = {}
    for kind in packing.kinds:
        files |= KINDS[kind](packing)
    if packing.license == LICENSE:
        files["LICENSE"] = packing.filled("LICENSE")
    name = packing.name
    for file, text in source.files.items():
        if file.endswith((".c", ".h")):
            tested = file.startswith(f"{name}_selftest")
            files[f"{'test' if tested else 'src'}/{file}"] = text
    return files


def write(spec: Spec, source: Source, kinds: Sequence[str], target: Path) -> list[str]:
    """Write a package into a folder, completely or not at all; names of its files."""
    files = packaged(spec, source, kinds)
    if (target / "CMakeLists.txt").exists() and not (target / "manifest.json").exists():
        expected = "a folder of its own for the package"
        raise OutputError(str(target), given="a folder with a project in it", expected=expected)
    facts = json.loads(source.files["manifest.json"])
    facts.pop("files")
    write_package(target, files, facts)
    return sorted([*files, "manifest.json"])


def _cmake(packing: Packing) -> dict[str, str]:
    return {
        "CMakeLists.txt": packing.filled("CMakeLists.txt"),
        "examples/host/main.c": packing.filled("main.c"),
    }


def _cpp(packing: Packing) -> dict[str, str]:
    return {f"src/{packing.name}.hpp": packing.filled("wrapper.hpp"), **_cmake(packing)}


def _arduino(packing: Packing) -> dict[str, str]:
    packing.need("version", "author", kind="arduino")
    about, name = packing.spec.package, packing.name
    if name.lower().startswith("arduino") or len(name) > _ARDUINO:
        expected = f"a name that does not begin with arduino, of at most {_ARDUINO} characters"
        where = Place(packing.spec.file, "name")
        raise where.error(f"{name!r} for an Arduino library", expected)
    wide = packing.source.program.scalar == "double"
    facts = {
        "name": name,
        "version": about.version,
        "author": about.author,
        "maintainer": f"{about.author} <{about.email}>" if about.email else about.author,
        "sentence": packing.description,
        "paragraph": f"Generated by fkgen {__version__}: C99 without heap or libm.",
        "category": "Data Processing",
        "url": about.url,
        "architectures": _WIDE if wide else "*",
        "includes": f"{name}.h",
    }
    lines = (f"{key}={value}" for key, value in facts.items() if value)
    words = [f"{name}_{verb}\tKEYWORD2" for verb in ("init", "step", "update", "predict")]
    return {
        "library.properties": "\n".join([f"# {SPDX}", *lines, ""]),
        "keywords.txt": "\n".join([f"# {SPDX}", f"{name}_t\tKEYWORD1", *words, ""]),
        f"examples/{name}/{name}.ino": packing.filled("sketch.ino"),
    }


def _platformio(packing: Packing) -> dict[str, str]:
    packing.need("version", "author", kind="platformio")
    about = packing.spec.package
    author = {"name": about.author, "email": about.email, "url": about.url}
    facts: dict[str, Any] = {
        "name": packing.name,
        "version": about.version,
        "description": packing.description,
        "keywords": ["kalman filter", "state estimation", packing.spec.filter.family],
        "authors": [{key: text for key, text in author.items() if text}],
        "license": packing.license,
        "frameworks": "*",
        "platforms": "*",
        "headers": f"{packing.name}.h",
        "build": {"flags": ["-ffp-contract=off"], "srcDir": "src", "includeDir": "src"},
    }
    return {"library.json": json.dumps(facts, indent=2) + "\n"}


def _zephyr(packing: Packing) -> dict[str, str]:
    name = packing.name
    module = f"# {SPDX}\nname: {name}\nbuild:\n  cmake: zephyr\n  kconfig: zephyr/Kconfig\n"
    return {
        "zephyr/module.yml": module,
        "zephyr/CMakeLists.txt": packing.filled("zephyr.cmake"),
        "zephyr/Kconfig": packing.filled("Kconfig"),
    }


def _esp_idf(packing: Packing) -> dict[str, str]:
    packing.need("version", kind="esp-idf")
    about = packing.spec.package
    lines = [f"# {SPDX}", f'version: "{about.version}"', f'license: "{packing.license}"']
    lines += [f"description: {json.dumps(packing.description)}"]
    lines += [f"url: {json.dumps(about.url)}"] if about.url else []
    lines += ["dependencies:", '  idf: ">=4.4"', ""]
    return {"idf_component.yml": "\n".join(lines), **_cmake(packing)}


def _cmsis(packing: Packing) -> dict[str, str]:
    packing.need("version", "author", kind="cmsis")
    about, name = packing.spec.package, packing.name
    vendor = re.sub(r"[^A-Za-z0-9_-]+", "_", about.author).strip("_")
    root = ET.Element("package", schemaVersion="1.7.7")
    for key, text in (
        ("vendor", vendor),
        ("name", name),
        ("description", packing.description),
        ("url", about.url),
        ("license", "LICENSE" if packing.license == LICENSE else ""),
    ):
        if text or key == "url":
            ET.SubElement(root, key).text = text
    ET.SubElement(ET.SubElement(root, "releases"), "release", version=about.version).text = name
    component = ET.SubElement(
        ET.SubElement(root, "components"),
        "component",
        Cclass="Signal Processing",
        Cgroup=name,
        Cversion=about.version,
    )
    ET.SubElement(component, "description").text = packing.description
    files = ET.SubElement(component, "files")
    ET.SubElement(files, "file", category="header", name=f"src/{name}.h")
    for unit in packing.units:
        ET.SubElement(files, "file", category="source", name=unit)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode", xml_declaration=False)
    return {f"{vendor}.{name}.pdsc": f"{_XML}\n<!-- {SPDX} -->\n{text}\n"}


def _mex(packing: Packing) -> dict[str, str]:
    return {f"mex/{packing.name}_mex.c": packing.filled("mex.c")}


KINDS: dict[str, Callable[[Packing], dict[str, str]]] = {
    "cmake": _cmake,
    "arduino": _arduino,
    "platformio": _platformio,
    "zephyr": _zephyr,
    "esp-idf": _esp_idf,
    "cmsis": _cmsis,
    "mex": _mex,
    "cpp": _cpp,
}
