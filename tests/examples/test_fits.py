"""The Nile and the motor whose commands get lost: the pages say what the scripts find."""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest
from scripts import EXAMPLES, scripts_of

from fkgen.study.reports.starters import resource

pytestmark = pytest.mark.compiled


def lines_of(example):
    return (EXAMPLES / example / "README.md").read_text(encoding="utf-8").splitlines()


def test_the_page_about_the_nile_is_what_its_script_prints(capsys, monkeypatch):
    with scripts_of("nile", "run") as (run,):
        monkeypatch.setattr(run.Figure, "savefig", lambda *_, **__: None)
        run.main()
    printed = capsys.readouterr().out.splitlines()
    assert {line for line in printed if line.startswith("|")} <= set(lines_of("nile"))
    assert printed[-1] == "level_variance is at its bound 0"


def test_the_first_log_of_the_motor_is_that_of_the_page():
    with scripts_of("actuator_rate", "run") as (run,):
        found = run.fitted(run.logs(4))
    page = [line for line in lines_of("actuator_rate") if line.count("|") == 7]
    for j, (label, line) in enumerate(zip(run.LABELS.values(), page[2:], strict=True)):
        low, high = found.intervals[0, j]
        numbers = f"{found.estimates[0, j]:.3g} | {found.standard_errors[0, j]:.3g}"
        assert line.startswith(f"| {label} |")
        assert line.endswith(f"| {numbers} | {low:.3g} to {high:.3g} |")
    assert found.holds.mean() > 0.7


def test_code_on_the_page_about_fits_prints_what_stands_beside_it():
    pytest.importorskip("cvxpy", reason="autocovariance least squares is an optional extra")
    page = resource("docs/fit.md").read_text(encoding="utf-8")
    known = {}
    for code in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE):
        printed = StringIO()
        with redirect_stdout(printed):
            exec(compile(code, "fit.md", "exec"), known)  # noqa: S102
        assert printed.getvalue().splitlines() == re.findall(
            r"^print\(.*\)  # (.*)$", code, re.MULTILINE
        )


@pytest.mark.exhaustive
def test_intervals_of_two_hundred_logs_hold_the_truth_as_often_as_the_page_says():
    with scripts_of("actuator_rate", "run") as (run,):
        found = run.fitted(run.logs())
    assert (found.holds.mean(axis=0) > 0.92).all()
    shares = [line for line in lines_of("actuator_rate") if line.endswith("% |")][1:4]
    told = [f"| {share:.1%} |" for share in found.holds.mean(axis=0)]
    assert all(line.endswith(share) for line, share in zip(shares, told, strict=True))
    spread = found.estimates.std(axis=0)
    np.testing.assert_allclose(np.nanmedian(found.standard_errors, axis=0), spread, rtol=0.15)
