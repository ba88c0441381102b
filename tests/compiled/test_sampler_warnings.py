"""The C that draws trials compiles without a warning, as what is shipped does."""

from __future__ import annotations

import subprocess

import jump_plants
import plants
import pytest
from sensor_specs import SCALAR
from toolchain import BITS, C_COMPILERS, FLAGS, each

from fkgen.trials.sampling import render_sampler

MOMENTS = {"problem": "moments", "gamma_rate": 0.6, "gamma_persistence": 0.8}
SPECS = {
    "kf": plants.spec(plants.VARYING, parameters=plants.PARAMETERS),
    "mkf": plants.motor(),
    "mme": plants.motor("mme"),
    "moments": plants.spec(SCALAR, family="linear_optimal", sensor=MOMENTS),
    "jump": jump_plants.spec_of(jump_plants.EXAMPLE_B, arrival_rate=0.8),
}


@pytest.mark.compiled
@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("name", SPECS)
def test_a_sampler_compiles_without_a_warning(name, compiler, tmp_path):
    source = render_sampler(SPECS[name])
    text = tmp_path / "sampler.c"
    text.write_text(source.text)
    flags = ["-std=c99", *FLAGS, BITS, "-O1"]  # without -Wmissing-prototypes: it has no header
    command = [*C_COMPILERS[compiler], *flags, "-c", str(text), "-o", str(tmp_path / "sampler.o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
