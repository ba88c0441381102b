"""The page about a filter: what stands on it is what the API says, and nothing is loaded."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.study.reports.whiteness import correlations

TABLE = {
    "name": "tracked",
    "model": {
        "A": [[1.0, 0.1], [0.0, 0.95]],
        "C": [[1.0, 0.0], [0.5, 1.0]],
        "Q": [[0.001, 0.0], [0.0, 0.01]],
        "R": [[0.04, 0.01], [0.01, 0.09]],
        "x0": [0.0, 1.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
        "states": [{"name": "place", "unit": "m"}, {"name": "speed", "unit": "m/s"}],
        "outputs": [{"name": "near"}, {"name": "far"}],
    },
    "faults": {
        "sensor": {
            "noise_factor": 10.0,
            "problem": 3,
            "gamma_chain": [[0.5, 0.5], [0.1, 0.9]],
            "delta_chain": [[0.9, 0.1], [0.4, 0.6]],
        }
    },
    "filter": {"family": "imm"},
}
HEADINGS = (
    *("Model", "Equations", "Faults", "Proof", "Consistency", "Calibration of mode probabilities"),
    *("Error against time", "Sample run", "Size and speed", "How to embed it", "Reproduce"),
)
OF_RECORD = ("Innovations", "Whiteness", "NIS", "Declared faults", "Gaps")
OF_RECORD += ("Error in the record against time",)
STEPS = 120


class Reader(HTMLParser):
    """Headings, tables by label, ids, and what an attribute refers to."""

    def __init__(self, html):
        super().__init__()
        self.headings, self.tables, self.ids, self.links = [], {}, [], []
        self.label, self.cell = "", None
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.ids += [given["id"]] if "id" in given else []
        self.links += [v for k, v in attributes if k in {"href", "src", "srcset", "data", "action"}]
        self.label = given.get("aria-label", self.label)
        if tag == "tr":
            self.tables.setdefault(self.label, []).append([])
        if tag in {"td", "th", "h2"}:
            self.cell = ""

    def handle_data(self, data):
        if self.cell is not None:
            self.cell += data

    def handle_endtag(self, tag):
        if tag == "h2":
            self.headings.append(self.cell)
        elif tag in {"td", "th"}:
            self.tables[self.label][-1].append(self.cell)
        else:
            return
        self.cell = None


@pytest.fixture(scope="module")
def spec():
    return fkgen.Spec.from_dict(TABLE)


@pytest.fixture(scope="module")
def log(tmp_path_factory, spec):
    """A drawn record with its truth beside it, missing rows and a gap of ten samples."""
    drawn = fkgen.simulate(spec, 1, STEPS, 5)
    y = drawn.y[0].copy()
    y[30:40] = np.nan
    y[50:60, 0] = np.nan
    file = tmp_path_factory.mktemp("log") / "log.csv"
    table = np.column_stack([0.1 * np.arange(STEPS), y, drawn.state[0]])
    lines = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in table]
    file.write_text("\n".join(["t,near,far,true.place,true.speed", *lines]) + "\n")
    return file, y, drawn.state[0]


@pytest.fixture(scope="module")
def page(spec, log):
    return fkgen.report(spec, record=log[0], truth=log[0])


@pytest.fixture(scope="module")
def read(page):
    return Reader(page.html)


def test_sections_are_those_that_were_agreed(read):
    assert [each for each in HEADINGS if each not in read.headings] == []
    assert [each for each in OF_RECORD if each not in read.headings] == []
    assert "Record log.csv" in read.headings


def test_the_same_inputs_give_the_same_bytes(spec, log, page):
    assert fkgen.report(spec, record=log[0], truth=log[0]).html == page.html


def test_nothing_is_loaded_from_elsewhere(page, read):
    inside = [each for each in read.links if not each.startswith("#")]
    assert inside == ["data:,"]  # the icon
    assert not re.search(r"https?:|url\((?!#)|@import|<script", page.html)


def test_names_within_the_page_are_unique_and_there(read):
    assert len(set(read.ids)) == len(read.ids)
    assert {each[1:] for each in read.links if each.startswith("#")} <= set(read.ids)


def test_formulas_and_figures_are_well_formed(page):
    formulas = re.findall(r"<math.*?</math>", page.html, re.DOTALL)
    figures = re.findall(r"<svg.*?</svg>", page.html, re.DOTALL)
    assert len(formulas) >= 9  # four equations and A, C, Q, R, x0, P0
    assert len(figures) >= 10
    assert "Detection against false alarms" in page.html
    for each in formulas:
        ET.fromstring(each)  # noqa: S314 - our own
    for each in figures:
        svg = ET.fromstring(each)  # noqa: S314
        named = {child.get("id"): child.text for child in svg if child.tag in {"title", "desc"}}
        assert svg.get("role") == "img"
        assert list(named) == svg.get("aria-labelledby").split()
        assert all(named.values())


def test_proof_is_that_of_validate(spec, read):
    claims = fkgen.validate(spec).claims
    said = [row for row in read.tables["Claims that were proved"][1:] if row[5] == "measured"]
    assert [row[0] for row in said] == [each.claim for each in claims]
    for row, claim in zip(said, claims, strict=True):
        numbers = [float(each) for each in row[2:4]]
        assert numbers == pytest.approx([claim.error, claim.tolerance], rel=0.05)  # two digits
        assert row[4] == "yes"


def test_statistics_are_those_of_the_campaign(spec, read):
    found = fkgen.montecarlo(spec, 400, 200, 0)
    said = {(row[0], row[1]): row[2:] for row in read.tables["Statistics of the campaign"][1:]}
    for key, of, i in (("rmse", "place", 0), ("rmse", "speed", 1), ("nees", "", ...)):
        value, error = map(float, said[key, of][0].split("\N{PLUS-MINUS SIGN}"))
        statistic = getattr(found, key)
        assert error == pytest.approx(float(statistic.standard_error[i]), rel=0.05)  # two digits
        assert value == pytest.approx(float(statistic.value[i]), abs=0.06 * error)
    for i, area in enumerate(found.roc.area.value):
        assert float(said["roc", f"mode {i}, area"][0].split("\N{PLUS-MINUS SIGN}")[0]) == (
            pytest.approx(area, abs=0.06 * found.roc.area.standard_error[i])
        )
    for key, verdict in found.verdicts.items():
        first = next(row for row in read.tables["Statistics of the campaign"] if row[0] == key)
        assert first[3] == verdict


def test_errors_in_the_record_are_those_of_a_run(spec, log, read):
    _, y, truth = log
    run = fkgen.build(spec).run(y)
    error = truth - run.filtered_state
    sd = np.sqrt(np.diagonal(run.filtered_covariance, axis1=1, axis2=2))
    for i, row in enumerate(read.tables["Errors in the record"][1:]):
        sizes = [float(each.split()[0]) for each in row[1:3]]
        expected = [np.sqrt(np.mean(each[:, i] ** 2)) for each in (error, sd)]
        assert sizes == pytest.approx(expected, rel=1e-3)  # four digits
        inside = [np.mean(np.abs(error[:, i]) <= k * sd[:, i]) for k in (1, 2, 3)]
        said = [float(each.rstrip("%")) / 100.0 for each in row[3:]]
        assert said == pytest.approx(inside, abs=6e-4)


def test_whiteness_is_that_of_the_innovations_that_came(spec, log, read):
    run = fkgen.build(spec).run(log[1])
    for i, row in enumerate(read.tables["Whiteness of innovations"][1:]):
        z = run.innovation[:, i] / np.sqrt(run.innovation_covariance[:, i, i])
        z = z[np.isfinite(z)]
        first = sum(a * b for a, b in zip(z[1:], z[:-1], strict=True)) / sum(a * a for a in z)
        assert [row[0], int(row[1])] == [spec.model.outputs[i].name, len(z)]
        assert float(row[2]) == pytest.approx(first, abs=6e-4)


def test_declared_faults_and_gaps_are_those_of_the_run(spec, log, read):
    declared = fkgen.build(spec).run(log[1]).mode_probability[:, 0] < 0.5
    rows = read.tables["Declared faults"][1:]
    edges = np.flatnonzero(np.diff([0, *declared, 0]))
    lengths = [str(b - a) for a, b in edges.reshape(-1, 2)]
    assert [row[1] for row in rows] == lengths[:30]
    assert len(read.tables["Gaps"]) == 2  # the head, and the ten samples without any row


def test_correlations_count_measurements_and_do_not_cross_records():
    z = np.array([[1.0, np.nan, 2.0, -1.0], [3.0, 1.0, np.nan, np.nan]])[..., None]
    covariance = np.full((2, 4, 1, 1), 4.0)
    found = correlations(2.0 * z, covariance)
    assert found.count == pytest.approx([5.0])
    assert found.products[0, :4] == pytest.approx([16.0, 2.0 - 2.0 + 3.0, -1.0, 0.0])
    assert found.value[0, 0] == pytest.approx(3.0 / 16.0)


def test_white_noise_is_white_and_a_sum_of_it_is_not():
    noise = np.random.default_rng(1).standard_normal((1, 4000, 2))
    noise[..., 1] += np.roll(noise[..., 1], 1, axis=1)
    white, coloured = correlations(noise, None).probability
    assert white > 0.01
    assert coloured < 1e-6


@pytest.mark.parametrize(
    ("record", "truth", "expected"),
    [
        (None, "log.csv", "truth: given a truth without a record"),
        ("none.csv", None, "none.csv"),
        ("log.csv", "other.csv", "place"),
        ("log.csv", "short.csv", "1 sample"),
        ("words.csv", None, "near"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, log, record, truth, expected):
    (tmp_path / "log.csv").write_bytes(log[0].read_bytes())
    (tmp_path / "other.csv").write_text("t,somewhere\n0,1\n")
    (tmp_path / "short.csv").write_text("t,place,speed\n0,1,1\n")
    (tmp_path / "words.csv").write_text("t,near,far\n0,here,there\n")
    target = tmp_path / "page.html"
    result = asked(tmp_path, target, record, truth)
    assert result.exit_code == 2
    (line,) = result.stderr.strip().splitlines()
    assert expected in line
    assert not target.exists()


def asked(folder, target, record=None, truth=None, *more):
    file = folder / "spec.json.toml"
    model = "\n".join(f"{key} = {text(value)}" for key, value in TABLE["model"].items())
    faults = "\n".join(f"{k} = {text(v)}" for k, v in TABLE["faults"]["sensor"].items())
    file.write_text(
        f'name = "tracked"\n[model]\n{model}\n[faults.sensor]\n{faults}\n[filter]\nfamily = "imm"\n'
    )
    options = ["--record", str(folder / record)] if record else []
    options += ["--truth", str(folder / truth)] if truth else []
    return CliRunner().invoke(main, ["report", str(file), "-o", str(target), *options, *more])


def text(value):
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {text(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)


def test_a_page_is_written_and_not_over_another(tmp_path):
    target = tmp_path / "page.html"
    assert asked(tmp_path, target).exit_code == 0
    first = target.read_bytes()
    assert first.endswith(b"</html>\n")
    again = asked(tmp_path, target)
    assert (again.exit_code, target.read_bytes()) == (2, first)
    assert "--force" in again.stderr


def test_an_output_that_cannot_be_written_is_named_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    result = asked(tmp_path, tmp_path / "file" / "page.html")
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file", "spec.json.toml"]


def shown(folder, html):
    """What a browser makes of a page, what it complains of, what the page asks a network for."""
    file, log = folder / "page.html", folder / "net.json"
    file.write_text(html)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += [f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}", "--dump-dom"]
    found = subprocess.run(
        [*command, file.as_uri()], capture_output=True, text=True, timeout=60, check=True
    )
    asked_for = re.findall(r'"initiator":"([^"]*)".*"url":"(http[^"]*)"', log.read_text())
    outside = [url for by, url in asked_for if by != "not an origin"]  # those are the browser's own
    return found.stdout, found.stderr, outside


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_shows_it_without_an_error_or_a_request(tmp_path, page):
    dom, complaints, outside = shown(tmp_path, page.html)
    assert [each for each in HEADINGS if f">{each}</h2>" not in dom] == []
    assert "CONSOLE" not in complaints
    assert outside == []


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_request_would_be_seen(tmp_path):
    address = "http://127.0.0.1:9/x.png"
    assert shown(tmp_path, f'<img src="{address}">')[2] == [address]


def test_a_filter_with_windows_has_innovations_of_its_host_alone():
    spec = fkgen.load(Path(__file__).parents[3] / "examples/soft_fault/cpcf.toml")
    found = fkgen.montecarlo(spec, 8, 160)
    assert len(found.outputs) == len(found.sensor_nis.value)
    assert "nis" in found._repr_html_()


def test_a_filter_that_tests_every_sample_has_a_record_too(tmp_path):
    """It declares faults, with neither modes nor windows to be drawn."""
    jump = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5]}
    jump |= {"modes": [{}, {"A": [[0.5]]}], "arrival_rate": 0.8, "arrival": "unknown"}
    model = {key: [[1.0]] for key in "ACQRP"} | {"x0": [0.0]}
    model["P0"] = model.pop("P")
    tried = {"family": "mjls_lmmse", "detector": "llr"}
    table = {"name": "lost", "model": model, "faults": {"jump": jump}, "filter": tried}
    spec = fkgen.Spec.from_dict(table)
    drawn = fkgen.simulate(spec, 1, 60, 0)
    np.savetxt(tmp_path / "log.csv", drawn.y[0], header="y0", comments="")
    read = Reader(fkgen.report(spec, record=tmp_path / "log.csv").html)
    declared = fkgen.build(spec).run(drawn.y[0]).fault_declared.ravel() > 0
    rows = read.tables["Declared faults"][1:]
    assert declared.any()
    assert sum(int(row[1]) for row in rows) == declared.sum()
