"""`fkgen verify --prove`: what Frama-C says of a filter, and of one that has a fault."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
from click.testing import CliRunner
from plants import generated, motor

from fkgen.cli import main
from fkgen.errors import CompilerError
from fkgen.proof import eva
from fkgen.study.reports.starters import starter

needs_frama_c = pytest.mark.skipif(
    shutil.which("frama-c") is None, reason="needs Frama-C: apt install frama-c-base"
)


@needs_frama_c
def test_the_command_proves_a_filter(tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text(starter("kf"), encoding="utf-8")
    done = CliRunner().invoke(main, ["verify", str(path), "--prove", "--json"])
    assert done.exit_code == 0, done.output
    assert '"error": 0.0' in done.output
    assert "Frama-C" in done.output


@needs_frama_c
def test_a_read_beyond_an_array_is_an_alarm_with_its_line():
    source = generated(motor("kf"))
    text = source.files["plant.c"]
    whole, beyond = "i < PLANT_NY; ++i", "i <= PLANT_NY; ++i"
    assert whole in text
    broken = replace(source, files={**source.files, "plant.c": text.replace(whole, beyond, 1)})
    claim = eva.proved(broken, "25.0")
    line = text[: text.index(whole)].count("\n") + 1
    assert not claim.holds
    assert any(f"plant.c:{at} out of bounds" in claim.claim for at in range(line, line + 12))


@needs_frama_c
def test_a_read_of_what_a_refusal_left_unwritten_is_an_alarm():
    source = generated(motor("kf"))
    text = source.files["plant.c"]
    tested = "    if (status != PLANT_OK) { return status; }\n    status = plant_propagate"
    assert tested in text
    careless = text.replace(tested, tested[tested.index("\n") + 1 :])
    claim = eva.proved(replace(source, files={**source.files, "plant.c": careless}), "25.0")
    assert not claim.holds
    assert "uninitialized" in claim.claim


def test_frama_c_that_is_missing_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(CompilerError, match="apt install frama-c-base"):
        eva.steps(motor("kf"))
