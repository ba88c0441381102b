"""A parameter may have any name that is read: no macro of a header, nor of the filter, is one."""

from __future__ import annotations

import keyword
import re

from plants import generated, spec
from toolchain import ANY, C_COMPILERS, CPP_COMPILERS, FLAGS, call, check_only, needs_compiler

from fkgen.errors import SpecError

pytestmark = needs_compiler()

HEADERS = "".join(f"#include <{name}.h>\n" for name in ("stdint", "stddef", "float", "math"))
ONE = [[1.0]]
#: Names of parameters, macros of others, types and functions of the filter that do no harm.
HARMLESS = ["B1", "F", "PI", "E", "valid", "self", "params", "next", "t0", "plant_t", "plant_init"]
HARMLESS += ["y", "u", "sinh1", "T_S", "dbl_max", "Infinity", "match", "type", "plant_params_t"]


def with_parameters(names):
    model = {"A": ONE, "C": ONE, "Q": ONE, "R": ONE, "x0": [0.0], "P0": ONE}
    rows = [
        " + ".join(f"0.1*{name}" for name in names[at : at + 40]) for at in range(0, len(names), 40)
    ]
    model["B"] = [rows]
    return spec(model, parameters=dict.fromkeys(names, 1.0))


def accepted(name):
    try:
        with_parameters([name])
    except SpecError as error:
        return error.key != f"parameters.{name}"  # refused anywhere else, it counts as read
    return True


def test_what_is_read_compiles_and_what_would_not_is_refused_where_it_is_declared(tmp_path):
    (tmp_path / "headers.c").write_text(HEADERS)
    generated(with_parameters(["tau"])).write(tmp_path / "own")
    texts = [
        call(*ANY, *f, "-dM", "-E", "headers.c", cwd=tmp_path).stdout for f in ([], ["-std=c99"])
    ]
    texts += [path.read_text() for path in (tmp_path / "own").glob("plant.[ch]")]
    words = set(re.findall(r"^#define ([A-Za-z]\w*)", "\n".join(texts), re.MULTILINE))
    words |= set(re.findall(r"^    (PLANT_\w+) =", texts[-1] + texts[-2], re.MULTILINE))
    words |= {*keyword.kwlist, *HARMLESS}
    names = sorted(
        {word.lower(): word for word in words if "__" not in word and accepted(word)}.values()
    )
    assert set(HARMLESS) <= set(names)
    assert not {"DBL_MAX", "SIZE_MAX", "INT32_MAX", "PLANT_NX", "PLANT_OK", "lambda"} & set(names)
    generated(with_parameters(names)).write(tmp_path / "out")
    for command, language in ((C_COMPILERS, "-std=gnu11"), (CPP_COMPILERS, "-xc++")):
        for name, compiler in command.items():
            flags = [language, *FLAGS, check_only(name), "-include", tmp_path / "headers.c"]
            call(*compiler, *flags, "plant.c", cwd=tmp_path / "out")
