"""The sizes that a header states: held against what compilers report."""

from __future__ import annotations

import json
import re
import shutil
from functools import cache

import pytest
import sensor_specs
import spread
from plants import generated
from toolchain import BITS, call

from fkgen.backend.size.stack import BYTES

M4F = ("-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
TARGETS = {"x86-64": ("gcc",), "cortex-m4f": ("arm-none-eabi-gcc", *M4F)}

FEW = ("kf", "kf_wide", "mme_gaussian", "compression_full", "imm", "linear_optimal")
CASES = [
    pytest.param(name, scalar, marks=() if name in FEW else pytest.mark.exhaustive)
    for scalar in ("double", "float")
    for name in (*spread.NAMES, *sensor_specs.EVERY)
]

_NODE = re.compile(r'node: \{ title: "([^"]*)" label: "[^"]*?\\n(\d+) bytes')
_EDGE = re.compile(r'edge: \{ sourcename: "([^"]*)" targetname: "([^"]*)"')


def source_of(name, scalar):
    return generated((spread.specs(scalar) | sensor_specs.every(scalar))[name])


def deepest(command, level, folder, name):
    """Bytes that the call of a public function takes with all that it calls, the largest."""
    flags = ("-std=c99", BITS, level, "-fcallgraph-info=su", "-c")
    call(*command, *flags, f"{name}.c", "-o", "size.o", cwd=folder)
    graph = "".join(path.read_text() for path in folder.glob("*.ci"))
    own = {title: int(size) for title, size in _NODE.findall(graph)}
    calls = _EDGE.findall(graph)

    @cache
    def depth(title):
        below = [depth(callee) for caller, callee in calls if caller == title]
        return own.get(title, 0) + max(below, default=0)

    verbs = tuple(f"{name}_{verb}" for verb in ("step", "update", "predict"))
    return max(depth(title) for title in own if title.split(":")[-1] in verbs)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(("name", "scalar"), CASES)
def test_no_call_takes_more_stack_than_the_header_says(name, scalar, target, tmp_path):
    if shutil.which(TARGETS[target][0]) is None:
        pytest.skip(f"no {TARGETS[target][0]}")
    source = source_of(name, scalar)
    source.write(tmp_path)
    stated = json.loads(source.files["manifest.json"])["bytes"]
    for level in ("-O0", "-Os"):
        found = deepest(TARGETS[target], level, tmp_path, source.program.name)
        bound = stated[f"stack_{level[1:]}"]
        assert found <= bound, (level, found, bound)
        # a bound that says nothing is none: at -Os arrays that never live together share a place
        assert bound <= 3.0 * found + 450, level


@pytest.mark.parametrize("name", [*FEW, "mkf_rate"])
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_the_header_states_the_sizes_of_instance_and_tables(name, scalar, tmp_path):
    source = source_of(name, scalar)
    stated = json.loads(source.files["manifest.json"])["bytes"]
    header = " ".join(source.files[f"{source.program.name}.h"].replace("\n *", " ").split())
    assert f"{stated['instance']} bytes; nothing else is kept" in header
    assert f"Tables of constants: {stated['constants']} bytes" in header
    assert f"at most {stated['stack_O0']} bytes at -O0, {stated['stack_Os']} at -Os" in header
    arrays = re.findall(
        r"^static const \w+ \w+((?:\[\d+\])+) = ", source.files["plant.c"], re.MULTILINE
    )
    sizes = [[int(n) for n in re.findall(r"\d+", brackets)] for brackets in arrays]
    entries = sum(a[0] * (a[1] if len(a) > 1 else 1) for a in sizes)
    assert stated["constants"] == BYTES[scalar] * entries > 0
