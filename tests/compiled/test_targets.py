"""Firmware on emulated processors: the host's bits, true figures, and failures that are told."""

from __future__ import annotations

import json
import shutil
import tomllib

import pytest
from click.testing import CliRunner

import fkgen
from fkgen.backend.lines import environment
from fkgen.cli import main
from fkgen.proof import agreement
from fkgen.target import avr, emulator, toolchain
from fkgen.target.boards import BOARDS, board
from fkgen.target.elf import read_image
from fkgen.target.emulator import Emulator
from fkgen.target.verify import STEPS, on_host, tried

SPEC = {
    "name": "axis",
    "model": {
        "A": [[1, "dt"], [0, 0.98]],
        "B": [[0], [0.1]],
        "C": [[1, 0]],
        "Q": [[0.01, 0], [0, 0.02]],
        "R": [["r"]],
        "x0": [0, 0],
        "P0": [[1, 0], [0, 1]],
        "outputs": [{"name": "position", "range": [-4.0, 4.0]}],
    },
    "parameters": {"dt": 0.1, "r": 0.3},
    "filter": {"family": "kf"},
    "code": {"scalar": "float"},
}


@pytest.fixture(scope="module")
def known():
    spec = fkgen.Spec.from_dict(SPEC)
    source, record = fkgen.generate(fkgen.validate(spec)), agreement.trial(spec, STEPS)
    return source, record, on_host(source, record)


def of_pip(monkeypatch):
    """As where neither a GNU compiler nor one of the system is installed."""
    found = shutil.which
    monkeypatch.setattr(
        toolchain.shutil,
        "which",
        lambda name: None if "gcc" in name and "-" in name else found(name),
    )


def test_a_cortex_m4f_by_pip_alone_gives_the_bits_of_the_host(known, monkeypatch):
    of_pip(monkeypatch)
    where = board("cortex-m4f")
    tools = toolchain.toolchain(where)
    claims, figures = tried(where, tools, *known)
    assert tools.name.startswith("zig cc")
    assert [claim.holds for claim in claims] == [True, True]
    assert {status for status, _ in known[2]} == {0, 1, 2}
    assert 60 < figures.instructions_min < figures.instructions_max < 500
    assert 500 < figures.flash < 4000
    assert figures.ram == len(known[2][0][1])
    assert 16 < figures.stack < 400
    source, record, expected = known
    k = STEPS - 1
    wrong = [*expected[:k], (0, expected[k][1][:-1] + bytes([expected[k][1][-1] ^ 1]))]
    assert [c.error for c in tried(where, tools, source, record, wrong)[0]] == [1 / STEPS, 0.0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", BOARDS)
def test_every_target_gives_the_bits_of_the_host(known, name):
    try:
        tools = toolchain.toolchain(board(name))
        emulator.emulator(board(name))
    except fkgen.CompilerError as missing:
        pytest.skip(str(missing))
    claims, _ = tried(board(name), tools, *known)
    assert all(claim.holds for claim in claims)


def program(folder, step):
    """A program of a function of its own."""
    where = board("cortex-m4f")
    tools = toolchain.toolchain(where)
    text = f"volatile float x = 1.5f;\nint fkgen_step(void);\nint run(void);\n{step}\n"
    text += "int fkgen_step(void) { return run(); }\n"
    (folder / "own.c").write_text(text, encoding="utf-8")
    script = environment().get_template("board.ld").render()
    (folder / "board.ld").write_text(script, encoding="utf-8")
    tools.run("-O1", "-c", "own.c", "-o", "own.o", folder=folder)
    return where, read_image(
        toolchain.linked(tools, [folder / "own.o"], ["fkgen_step", "run"], folder / "own.elf")
    )


def test_instructions_are_counted_one_by_one(tmp_path):
    step = (
        "int run(void) { int i; for (i = 0; i < 9; ++i) { x = x * 1.25f + 1.0f / x; } return -7; }"
    )
    where, image = program(tmp_path, step)
    machine = Emulator(where, image)
    assert machine.call("run") == -7
    counted = machine.instructions
    slow, seen = Emulator(where, image), []
    slow._machine.hook_add(
        emulator.unicorn().UC_HOOK_CODE, lambda _, address, *__: seen.append(address)
    )
    slow.call("run")
    assert counted == len(seen) > 50
    assert machine.call("fkgen_step") == -7
    assert machine.instructions == counted  # but for what stands around


def test_what_hangs_is_stopped_and_what_faults_is_told(tmp_path):
    where, image = program(tmp_path, "int run(void) { while (x > 0.0f) { x = 1.0f; } return 0; }")
    with pytest.raises(fkgen.CompilerError, match=r"did not return within 0\.2 s: stopped"):
        Emulator(where, image, seconds=0.2).call("run")
    wild = "int run(void) { return *(volatile int *)0x60000000; }"
    where, image = program(tmp_path, wild)
    with pytest.raises(fkgen.CompilerError, match="cortex-m4f: run met a fault at 0x1"):
        Emulator(where, image).call("run")


def test_a_missing_tool_is_named_with_what_installs_it(monkeypatch):
    of_pip(monkeypatch)
    monkeypatch.setattr(toolchain.importlib.util, "find_spec", lambda _: None)
    for name, command in (
        ("cortex-m3", "pip install ziglang, or: apt install gcc-arm-none-eabi"),
        ("avr", "apt install gcc-avr avr-libc"),
        ("rv64gc", "pip install ziglang"),
    ):
        with pytest.raises(
            fkgen.CompilerError, match=f"no compiler for {name}; install.*{command}"
        ):
            toolchain.toolchain(board(name))

    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(emulator, "import_module", absent)
    with pytest.raises(fkgen.CompilerError, match="pip install unicorn"):
        emulator.emulator(board("rv64gc"))

    def refused(*_, **__):
        raise fkgen.CompilerError("no such header")

    avr.library.cache_clear()
    monkeypatch.setattr(avr, "on_this_machine", refused)
    with pytest.raises(fkgen.CompilerError, match="apt install libsimavr-dev"):
        emulator.emulator(board("avr"))


def test_the_command_prints_figures_and_writes_evidence(tmp_path):
    spec, target = tmp_path / "axis.toml", tmp_path / "evidence.json"
    starter = CliRunner().invoke(main, ["new", "kf", "-o", str(spec)])
    assert starter.exit_code == 0
    call = ["verify", str(spec), "--target"]
    done = CliRunner().invoke(main, [*call, "cortex-m4f", "-o", str(target)])
    assert done.exit_code == 0, done.output
    assert "2 of 2 claims hold" in done.output
    facts = json.loads(target.read_text(encoding="utf-8"))
    assert facts["holds"] is True
    assert facts["targets"][0]["instructions_min"] > 0
    assert {"fkgen", "numpy", "casadi", "unicorn"} <= facts["versions"].keys()
    assert {"error", "tolerance", "holds"} <= facts["claims"][0].keys()
    assert tomllib.loads(spec.read_text(encoding="utf-8"))["name"] == facts["name"]
    unknown = CliRunner().invoke(main, [*call, "cortex-m4f,cortex-m9"])
    assert unknown.exit_code == 2
    assert "'cortex-m9'; expected one of cortex-m0plus, cortex-m3, cortex-m4f" in unknown.output
    refused = CliRunner().invoke(main, [*call, "avr"])
    assert refused.exit_code == 2
    assert "avr for a filter in double" in refused.output
