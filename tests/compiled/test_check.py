"""`<name>_check`: what a filter takes for an instance of its own, for a spec of every family."""

from __future__ import annotations

import copy
import tomllib
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
from plants import generated
from toolchain import needs_compiler, run_main

import fkgen
from fkgen.families import NAMES
from fkgen.study.reports.starters import starter
from fkgen.symbolic.interface import Status

pytestmark = needs_compiler()

SOUND, INVALID = str(Status.OK.value), str(Status.INVALID_INSTANCE.value)

DRIVER = """
#include "my_filter.h"
#include <stdio.h>
#include <string.h>
int main(void)
{{
    static const union {{ uint32_t bits; float value; }} none = {{ 0x7fc00000u }};
    const {real} nan = none.value, bad[2] = {{ -1, 2 }};
    my_filter_t f, g;
    size_t i;
    int caught = 0;
    memset(&f, 0, sizeof f);
    printf("%d\\n%d\\n", my_filter_check(NULL), my_filter_check(&f));
    {init};
    printf("%d\\n%d\\n", my_filter_check(&f), my_filter_selftest());
    for (i = 0; i < {members}; ++i)
    {{
        g = f;
        memcpy((char *)&g + i * sizeof nan, &nan, sizeof nan);
        caught += my_filter_check(&g) == MY_FILTER_INVALID_INSTANCE;
    }}
    printf("%d\\n", caught);
    g = f; g.predicted_covariance[0] = bad[0]; printf("%d\\n", my_filter_check(&g));
    g = f; g.updated = bad[1]; printf("%d\\n", my_filter_check(&g));
    g = f; g.model ^= 1u; printf("%d\\n", my_filter_check(&g));
    {probability}
    return 0;
}}
"""


def answers(spec, folder):
    source = generated(spec)
    source.write(folder)
    program, text = source.program, source.files["my_filter.h"]
    members = sum(port.size for port in program.ports) + 1 + len(program.repeats or ())
    init = "my_filter_init(&f)"
    if "my_filter_init(my_filter_t *self, " in text:
        init = "{ my_filter_params_t p; my_filter_params_init(&p); my_filter_init(&f, &p); }"
    weighed = any(port.name == "mode_probability" for port in program.ports)
    weight = 'g = f; g.mode_probability[0] = bad[1]; printf("%d\\n", my_filter_check(&g));'
    real = program.scalar
    text = DRIVER.format(real=real, init=init, members=members, probability=weight * weighed)
    told = run_main(folder, text, "my_filter.c", "my_filter_selftest.c")
    return told, [str(members), *[INVALID] * (3 + weighed)]


@pytest.mark.parametrize(("family", "scalar"), [*zip(NAMES, cycle(["double", "float"]))])
def test_a_check_finds_whatever_is_no_instance_of_the_filter(family, scalar, tmp_path):
    text = starter(family)
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    spec = fkgen.load(tmp_path / "spec.toml")
    spec = replace(spec, code=replace(spec.code, scalar=scalar))
    told, damaged = answers(spec, tmp_path / "out")
    assert told == [str(Status.NULL_POINTER.value), INVALID, SOUND, SOUND, *damaged]


@pytest.mark.parametrize("family", ["kf", "imm"])
def test_an_instance_keeps_its_model_through_calls_and_snapshots(family, tmp_path):
    (tmp_path / "spec.toml").write_text(starter(family), encoding="utf-8")
    spec = fkgen.load(tmp_path / "spec.toml")
    found, (p, q) = fkgen.build(spec), (spec.model.ny, spec.model.nu)
    model = int(generated(spec).program.digest[:8], 16)
    steps = [found.step(np.ones(p), np.ones(q)), found.update(np.ones(p), np.ones(q))]
    for at in (*steps, found.predict(np.ones(q)), copy.deepcopy(found).snapshot()):
        assert found.layout.structure().from_buffer_copy(at.data).model == model


@pytest.mark.parametrize("family", ["dfcf", "cpcf", "compression_full"])
def test_predictions_over_the_end_of_a_window_leave_an_instance(family, tmp_path):
    spec = fkgen.Spec.from_dict(tomllib.loads(starter(family)))
    source = generated(spec)
    source.write(tmp_path / "out")
    driven = f", (const double[{spec.model.nu}]){{ 0 }}" if spec.model.nu else ""
    params, given = "", ""
    if source.program.parameters:
        params = "my_filter_params_t params; (void)my_filter_params_init(&params);"
        given = ", &params"
    text = f"""
    #include "my_filter.h"
    #include <stdio.h>
    int main(void)
    {{
        my_filter_t f;
        int k, sound = my_filter_init(&f) == MY_FILTER_OK;
        {params}
        for (k = 0; k < 100; ++k)
        {{
            sound = sound && my_filter_predict(&f{given}{driven}) == MY_FILTER_OK;
            sound = sound && my_filter_check(&f) == MY_FILTER_OK;
        }}
        printf("%d\\n", sound);
        return 0;
    }}
    """
    assert run_main(tmp_path / "out", text, "my_filter.c") == ["1"]
