"""What judges a recursion shares no code with it, and the package keeps its promises on imports."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fkgen
from fkgen.families import NAMES, family

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "fkgen"
JUDGED = (
    "casadi",
    "fkgen.symbolic",
    "fkgen.estimators",
    "fkgen.families",
    "fkgen.backend",
    "fkgen.proof",
)


def imports(path):
    """Absolute names of everything that a module imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def loaded_by(statement):
    """Names of the modules that a fresh interpreter has loaded after a statement."""
    code = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    return set(json.loads(done.stdout))


@pytest.mark.parametrize(
    "path", sorted((PACKAGE / "oracle").rglob("*.py")), ids=lambda path: path.stem
)
def test_a_closed_form_imports_nothing_of_what_it_judges(path):
    judged = [name for name in imports(path) if name.startswith(JUDGED)]
    assert judged == []


def test_the_closed_forms_run_without_casadi():
    statement = (
        "import numpy as np, fkgen\n"
        "from fkgen.oracle.exact.batch import batch_lmmse\n"
        "from fkgen.oracle.exact.hypotheses import batch_posterior, textbook_mme\n"
        "from fkgen.oracle.plants.actuator import LinearSystem, simulate\n"
        "from fkgen.oracle.textbook.riccati import stationary_prediction\n"
        "one = [[1.0]]\n"
        "model = dict(A=[[0.5]], C=one, Q=one, R=one, x0=[0.0], P0=one)\n"
        "table = dict(name='a', filter=dict(family='kf'), model=model)\n"
        "s = LinearSystem.from_spec(fkgen.Spec.from_dict(table), 3)\n"
        "y = simulate(s, None, np.random.default_rng(1))\n"
        "batch_lmmse(s, y, None)\n"
        "textbook_mme([s], np.ones(1), y, None, weight_floor=0.0, likelihood='gaussian')\n"
        "batch_posterior([s], np.ones(1), y, None)\n"
        "stationary_prediction(*(getattr(s, m)[0] for m in 'ACQR'))"
    )
    loaded = loaded_by(statement)
    assert "scipy.stats" in loaded
    assert not {name for name in loaded if name.startswith(("casadi", "fkgen.symbolic"))}


def test_a_recursion_imports_no_oracle():
    for path in (*(PACKAGE / "symbolic").glob("*.py"), *(PACKAGE / "estimators").rglob("*.py")):
        assert not [name for name in imports(path) if name.startswith("fkgen.oracle")]


HEAVY = ("casadi", "sympy", "control", "matplotlib", "scipy", "jinja2")


def test_importing_fkgen_loads_none_of_its_heavy_libraries():
    heavy = {name.split(".")[0] for name in loaded_by("import fkgen")} & set(HEAVY)
    assert heavy == set()


def test_reading_a_spec_loads_none_of_the_heavy_libraries():
    path = next((ROOT / "examples").glob("*/*.toml"))
    heavy = {name.split(".")[0] for name in loaded_by(f"import fkgen; fkgen.load({str(path)!r})")}
    assert heavy & set(HEAVY) == set()


@pytest.mark.parametrize("name", fkgen.__all__)
def test_a_public_name_exists_and_says_what_it_is(name):
    value = getattr(fkgen, name)
    if name == "__version__":
        assert re.fullmatch(r"\d+\.\d+\.\d+\S*", value)
        return
    text = inspect.getdoc(value) or ""
    assert len(text) > 20
    first = text.split("\n\n")[0]
    assert first.rstrip().endswith((".", ":")), first


CALLED = [n for n in fkgen.__all__ if inspect.isfunction(getattr(fkgen, n))]
METHODS = (
    "run",
    "run_batch",
    "step",
    "state",
)


@pytest.mark.parametrize("name", CALLED)
def test_a_public_function_with_several_parameters_explains_each(name):
    assert_explained(getattr(fkgen, name))


@pytest.mark.parametrize("name", METHODS)
def test_a_method_of_a_compiled_filter_with_several_parameters_explains_each(name):
    assert_explained(getattr(fkgen.CompiledFilter, name))


def assert_explained(function):
    names = [name for name in inspect.signature(function).parameters if name != "self"]
    text = inspect.getdoc(function) or ""
    unnamed = [name for name in names if not re.search(rf"\b{name}\b", text, re.IGNORECASE)]
    assert unnamed == [] or len(names) == 1


@pytest.mark.parametrize("name", NAMES)
def test_the_source_of_a_recursion_names_equations_or_sections(name):
    from jump_plants import EXAMPLE_A, spec_of
    from plants import SENSED, motor

    broken = {"problem": 1, "gamma_rate": 0.9}
    sections = tuple(family(name).accepts)
    model = {"sensor": broken} if "sensor" in sections else {}
    if "soft" in sections:
        model = {"soft": {"host": [1], "window": 5}, "model": SENSED}
    jumping = sections == ("jump",)
    recursion = family(name).build(spec_of(EXAMPLE_A) if jumping else motor(name, **model))
    assert re.search(r"\b(eqs?\.|sec\.) ?\(?\d", recursion.source)
    assert all(re.search(r"\w", form.source) for form in family(name).closed_forms)


@pytest.mark.parametrize("name", NAMES)
def test_a_family_has_closed_forms_and_each_says_something_else(name):
    claims = [form.claim for form in family(name).closed_forms]
    assert len(set(claims)) == len(claims) >= 2


def text_files():
    names = ["fkgen", "tests", "tools", "templates", "examples", "generated", "docs", "bench"]
    for folder in names:
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in {".py", ".j2", ".toml", ".md", ".c", ".h", ".json", ".txt"}:
                yield path


ABSOLUTE = re.compile(r"(?<![\w.:/])/(?:work|home|root|Users)/\w")


def test_no_file_mentions_a_place_on_somebodys_machine():
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in text_files()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if ABSOLUTE.search(line)
    ]
    assert found == []


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE))
)
def test_a_module_says_what_it_is_for(path):
    assert ast.get_docstring(ast.parse(path.read_text()))
