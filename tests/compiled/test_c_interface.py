"""The C functions themselves: NULL, aliases, valid bits, update and predict against step."""

from __future__ import annotations

import numpy as np
import pytest
import spread
from plants import generated, motor, random_model, spec
from toolchain import needs_compiler, run_main

pytestmark = needs_compiler()

PRELUDE = """
#include "plant.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
#define SHOW(call) printf("%d\\n", (int)(call))
#define SAME(a, b) printf("%d\\n", memcmp(&(a), &(b), sizeof(a)) == 0)
"""


def lines(tmp_path, plant, body):
    generated(plant).write(tmp_path / "out")
    text = f"{PRELUDE}\nint main(void)\n{{\n{body}\n    return 0;\n}}\n"
    return run_main(tmp_path / "out", text, "plant.c", "plant_selftest.c", flags=["-lm"])


def test_null_pointers_are_refused_by_every_function(tmp_path):
    plant = spread.specs()["mkf_rate"]
    body = """
    plant_t f, before;
    plant_params_t params;
    double u[1] = {1.0}, y[2] = {0.1, 0.2};
    SHOW(plant_init(NULL));
    SHOW(plant_params_init(NULL));
    SHOW(plant_init(&f)); SHOW(plant_params_init(&params));
    before = f;
    SHOW(plant_step(NULL, &params, u, y, 3u)); SHOW(plant_step(&f, NULL, u, y, 3u));
    SHOW(plant_step(&f, &params, NULL, y, 3u)); SHOW(plant_step(&f, &params, u, NULL, 3u));
    SHOW(plant_update(NULL, &params, u, y, 3u)); SHOW(plant_update(&f, NULL, u, y, 3u));
    SHOW(plant_update(&f, &params, NULL, y, 3u)); SHOW(plant_update(&f, &params, u, NULL, 3u));
    SHOW(plant_predict(NULL, &params, u)); SHOW(plant_predict(&f, NULL, u));
    SHOW(plant_predict(&f, &params, NULL));
    SAME(f, before);
    """
    assert lines(tmp_path, plant, body) == ["-1", "-1", "0", "0", *["-1"] * 11, "1"]


@pytest.mark.parametrize("name", ["kf", "mkf_sensed", "mme", "mkf_exact"])
def test_update_then_predict_is_step_to_the_bit(name, tmp_path):
    plant = spread.specs()[name]
    p = plant.model.ny
    body = f"""
    plant_t a, b;
    int k;
    plant_init(&a); plant_init(&b);
    for (k = 0; k < 20; ++k)
    {{
        double u[1], y[{p}];
        int i;
        u[0] = 1.0 + 0.1 * k;
        for (i = 0; i < {p}; ++i) y[i] = ((k * 7 + i * 3) % 5 == 0) ? NAN : 0.3 * i + 0.01 * k;
        if (plant_step(&a, u, y, 3u) != plant_update(&b, u, y, 3u)) printf("status\\n");
        if (plant_predict(&b, u) != PLANT_OK) printf("predict\\n");
        if (memcmp(&a, &b, sizeof a) != 0) printf("bits %d\\n", k);
    }}
    """
    assert lines(tmp_path, plant, body) == []


def test_u_and_y_may_be_members_of_the_instance(tmp_path):
    plant = spread.specs()["mkf_sensed"]
    body = """
    plant_t a, b;
    double u[1], y[2];
    plant_init(&a); plant_init(&b);
    u[0] = 1.0; y[0] = 0.1; y[1] = 0.2;
    plant_step(&a, u, y, 3u); plant_step(&b, u, y, 3u);
    u[0] = a.filtered_state[0]; y[0] = a.predicted_state[0]; y[1] = a.predicted_state[1];
    SHOW(plant_step(&a, u, y, 3u));
    SHOW(plant_step(&b, b.filtered_state, b.predicted_state, 3u));
    SAME(a, b);
    """
    assert lines(tmp_path, plant, body) == ["0", "0", "1"]


def test_a_cleared_bit_a_nan_and_both_are_one_and_the_same(tmp_path):
    plant = spread.specs()["kf_correlated"]
    body = """
    plant_t start, f[4];
    double u[2] = {1.0, -1.0}, y[2] = {0.1, 0.2}, gap[2] = {0.1, NAN}, wild[2] = {0.1, INFINITY};
    int i;
    plant_init(&start);
    plant_step(&start, u, y, 3u);
    for (i = 0; i < 4; ++i) f[i] = start;
    SHOW(plant_step(&f[0], u, y, 1u)); SHOW(plant_step(&f[1], u, gap, 3u));
    SHOW(plant_step(&f[2], u, gap, 1u)); SHOW(plant_step(&f[3], u, wild, 1u));
    for (i = 1; i < 4; ++i) SAME(f[0], f[i]);
    SHOW(plant_step(&f[0], u, wild, 3u)); SAME(f[0], f[1]);
    SHOW(plant_step(&f[0], u, y, 0u)); SHOW(plant_step(&f[1], u, gap, 2u)); SAME(f[0], f[1]);
    SHOW(plant_step(&f[0], u, y, 0xfffffffcu));
    """
    expected = ["0"] * 4 + ["1"] * 3 + ["-2", "1", "1", "1", "1", "1"]
    assert lines(tmp_path, plant, body) == expected


def test_rows_beyond_the_first_word_have_bits_of_their_own(tmp_path):
    plant = spread.specs()["kf_wide"]
    body = """
    plant_t a, b;
    double y[PLANT_NY], gap[PLANT_NY];
    uint32_t all[PLANT_VALID_WORDS] = {0xffffffffu, 0xffffffffu};
    uint32_t less[PLANT_VALID_WORDS] = {0xfffffffeu, 0u};
    uint32_t none[PLANT_VALID_WORDS] = {0u, 0u};
    int i;
    for (i = 0; i < PLANT_NY; ++i) gap[i] = y[i] = 0.01 * i;
    gap[0] = gap[32] = NAN;
    plant_init(&a); plant_init(&b);
    SHOW(PLANT_NY); SHOW(PLANT_VALID_WORDS);
    SHOW(plant_step(&a, y, less)); SHOW(plant_step(&b, gap, all)); SAME(a, b);
    SHOW(plant_step(&a, y, all)); SHOW(plant_step(&b, y, less)); SAME(a, b);
    b = a;
    SHOW(plant_step(&a, y, none)); SHOW(plant_step(&a, NULL, none)); SHOW(plant_step(&a, y, NULL));
    """
    expected = ["33", "2", "0", "0", "1", "0", "0", "0", "1", "-1", "-1"]
    assert lines(tmp_path, plant, body) == expected


def test_two_instances_do_not_influence_each_other(tmp_path):
    plant = spread.specs()["mme"]
    body = """
    plant_t a, b, alone;
    double u[1] = {1.0}, y[2] = {0.1, 0.9}, z[2] = {-0.5, 0.1};
    int k;
    plant_init(&a); plant_init(&b); plant_init(&alone);
    for (k = 0; k < 10; ++k)
    {
        plant_step(&a, u, y, 3u);
        plant_step(&b, u, z, 3u);
        plant_step(&alone, u, y, 3u);
    }
    SAME(a, alone); SAME(a, b);
    """
    assert lines(tmp_path, plant, body) == ["1", "0"]


def test_macros_say_the_dimensions_and_where_covariances_are(tmp_path):
    plant = motor("mme")
    body = """
    plant_t f;
    int i, j;
    plant_init(&f);
    SHOW(PLANT_NX); SHOW(PLANT_NY); SHOW(PLANT_NU); SHOW(PLANT_NMODES);
    SHOW(PLANT_API_VERSION >= 1);
    for (i = 0; i < 2; ++i) for (j = 0; j < 2; ++j) SHOW(PLANT_P(i, j));
    printf("%g\\n", f.predicted_covariance[PLANT_P(0, 1)]);
    printf("%g\\n", f.mode_probability[4]);
    SHOW(plant_selftest());
    """
    expected = ["2", "2", "1", "5", "1", "0", "1", "1", "2", "0.5", "0.2", "0"]
    assert lines(tmp_path, plant, body) == expected


def test_an_instance_holds_its_members_and_nothing_else(tmp_path):
    plant = spread.specs("float")["mkf_independent"]
    program = generated(plant).program
    scalars = sum(port.size for port in program.ports) + 1 + len(program.repeats or ())
    assert lines(tmp_path, plant, "    SHOW(sizeof(plant_t));") == [str(4 * (scalars + 1))]
    assert f"An instance is {scalars} floats and 1 of uint32_t" in generated(plant).files["plant.h"]


def test_an_initialised_instance_has_no_byte_that_init_left_alone(tmp_path):
    plant = spec(random_model(83, 3, 2), family="kf")
    body = """
    plant_t a, b;
    memset(&a, 0x00, sizeof a); memset(&b, 0xff, sizeof b);
    plant_init(&a); plant_init(&b);
    SAME(a, b);
    """
    assert lines(tmp_path, plant, body) == ["1"]


def test_python_reads_the_same_start_as_c_has(tmp_path):
    plant = motor("kf")
    body = '    plant_t f; plant_init(&f); printf("%a\\n", f.predicted_covariance[1]);'
    P0 = plant.model.P0.values()
    assert float.fromhex(lines(tmp_path, plant, body)[0]) == np.float64(P0[0, 1])
