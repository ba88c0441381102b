"""Packages as their build systems take them, as far as that can be tried without a network."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fkgen.backend.source import complete
from fkgen.cli import main
from fkgen.target.packages import KINDS

SPEC = """
name = "axis"
[model]
A = [[1, "dt"], [0, 0.98]]
B = [[0], [0.1]]
C = [[1, 0]]
Q = [[0.01, 0], [0, 0.02]]
R = [["r"]]
x0 = [0, 1]
P0 = [["p", 0], [0, 1]]
inputs = [{name = "force", range = [2.0, 5.0]}]
states = [{name = "position"}, {name = "speed"}]
[parameters]
dt = 0.5
p = 4.0
r = 0.3
[filter]
family = "kf"
[code]
scalar = "float"
"""
PACKAGE = '[package]\nversion = "1.2.3"\nauthor = "Jane <Doe> & Co"\ndescription = "x & y"\n'
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror")


def run(*command, folder):
    words = list(map(str, command))
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def needs(tool):
    return pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not installed")


def generate(folder, text, kinds, target):
    spec = folder / "axis.toml"
    spec.write_text(text, encoding="utf-8")
    return CliRunner().invoke(
        main, ["generate", str(spec), "--package", kinds, "-o", str(folder / target)]
    )


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    folder = tmp_path_factory.mktemp("package")
    done = generate(folder, SPEC + PACKAGE, ",".join(KINDS), "axis")
    assert done.exit_code == 0, done.output
    return folder / "axis"


@needs("cmake")
def test_cmake_installs_it_and_a_consumer_finds_it(package, tmp_path):
    build, place = tmp_path / "build", tmp_path / "place"
    run("cmake", "-S", package, "-B", build, f"-DCMAKE_INSTALL_PREFIX={place}", folder=tmp_path)
    run("cmake", "--build", build, folder=tmp_path)
    assert "100% tests passed, 0 tests failed out of 2" in run("ctest", folder=build)
    run("cmake", "--install", build, folder=tmp_path)
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.13)\nproject(consumer C CXX)\n"
        "find_package(axis 1.1 CONFIG REQUIRED)\nadd_executable(consumer main.cpp)\n"
        "target_link_libraries(consumer PRIVATE axis::axis)\n"
        f"target_compile_options(consumer PRIVATE -std=c++11 {' '.join(STRICT)})\n"
    )
    (tmp_path / "main.cpp").write_text(
        "#include <axis.hpp>\nint main()\n{\n    axis::Parameters p;\n    axis::Filter f(p);\n"
        "    const float u[1] = {3.0f}, y[1] = {0.25f}, x[2] = {0.0f, 0.0f};\n"
        "    const float P[3] = {1.0f, 0.0f, 1.0f};\n    p.r = 0.1f;\n"
        "    bool ok = axis::accepted(f.start(x, P)) && axis::accepted(f.step(p, u, y));\n"
        "    ok = ok && axis::accepted(f.update(p, u, y, 0u)) && f.predict(p, u) == AXIS_OK;\n"
        "    return ok && f->filtered_state[AXIS_STATE_POSITION] > 0.0f ? 0 : 1;\n}\n"
    )
    other = tmp_path / "other"
    run("cmake", "-S", tmp_path, "-B", other, f"-DCMAKE_PREFIX_PATH={place}", folder=tmp_path)
    run("cmake", "--build", other, folder=tmp_path)
    run(other / "consumer", folder=tmp_path)


@needs("cmake")
@pytest.mark.parametrize("system", ["zephyr", "esp-idf"])
def test_its_build_files_give_zephyr_and_esp_idf_what_they_need(package, tmp_path, system):
    stubs = {
        "zephyr": f"set(CONFIG_AXIS y)\nset(CMAKE_CURRENT_LIST_DIR {package}/zephyr)\n"
        "function(zephyr_library)\n  add_library(it STATIC)\nendfunction()\n"
        "function(zephyr_library_sources)\n  target_sources(it PRIVATE ${ARGN})\nendfunction()\n"
        "function(zephyr_library_compile_options)\nendfunction()\n"
        "function(zephyr_include_directories)\n"
        "  target_include_directories(it PRIVATE ${ARGN})\nendfunction()\n"
        f"include({package}/zephyr/CMakeLists.txt)\n",
        "esp-idf": "set(ESP_PLATFORM 1)\nset(COMPONENT_LIB it)\n"
        'function(idf_component_register)\n  cmake_parse_arguments(A "" "" "SRCS;INCLUDE_DIRS"'
        " ${ARGN})\n  add_library(it STATIC ${A_SRCS})\n"
        "  target_include_directories(it PUBLIC ${A_INCLUDE_DIRS})\nendfunction()\n"
        f"add_subdirectory({package} axis)\n",
    }
    text = f"cmake_minimum_required(VERSION 3.13)\nproject(stub C)\n{stubs[system]}"
    (tmp_path / "CMakeLists.txt").write_text(text)
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build", folder=tmp_path)
    assert "it" in run("cmake", "--build", tmp_path / "build", folder=tmp_path)


@needs("avr-g++")
def test_the_sketch_is_compiled_for_an_arduino(package, tmp_path):
    (tmp_path / "sketch.cpp").write_text(
        "struct Port { void begin(long) {} void println(double) {} };\nstatic Port Serial;\n"
        "static int analogRead(int) { return 0; }\nstatic void delay(unsigned long) {}\n"
        + (package / "examples" / "axis" / "axis.ino").read_text()
        + "int main() { setup(); for (;;) { loop(); } }\n"
    )
    flags = ("-mmcu=atmega328p", "-Os", "-Wall", "-Wextra", "-Werror", f"-I{package / 'src'}")
    run("avr-gcc", "-std=c99", *flags, "-c", package / "src" / "axis.c", folder=tmp_path)
    run("avr-g++", *flags, "sketch.cpp", "axis.o", "-o", "sketch", folder=tmp_path)


def test_every_file_says_what_it_may_be_used_for(package):
    """All but JSON, which has no remarks, and texts for people."""
    files = [each for each in package.rglob("*") if each.is_file()]
    said = {each for each in files if "SPDX-License-Identifier: MIT-0" in each.read_text()}
    without = {each.suffix or each.name for each in files if each not in said}
    assert without <= {".json", ".md", "LICENSE"}
    assert "MIT No Attribution" in (package / "LICENSE").read_text()
    assert json.loads((package / "library.json").read_text())["license"] == "MIT-0"


def test_a_package_with_a_licence_of_its_own_holds_no_other(tmp_path):
    done = generate(tmp_path, SPEC + PACKAGE + 'license = "Apache-2.0"\n', "platformio", "own")
    assert done.exit_code == 0, done.output
    assert not (tmp_path / "own" / "LICENSE").exists()
    assert json.loads((tmp_path / "own" / "library.json").read_text())["license"] == "Apache-2.0"


def test_metadata_say_what_the_spec_says(package):
    lines = (package / "library.properties").read_text().splitlines()
    facts = dict(line.split("=", 1) for line in lines if not line.startswith("#"))
    required = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category"}
    assert required <= facts.keys()
    assert (facts["version"], facts["architectures"]) == ("1.2.3", "*")
    library = json.loads((package / "library.json").read_text())
    assert (library["name"], library["version"]) == ("axis", "1.2.3")
    assert library["authors"] == [{"name": "Jane <Doe> & Co"}]
    assert library["build"]["flags"] == ["-ffp-contract=off"]
    component = (package / "idf_component.yml").read_text().splitlines()
    assert component[1:4] == ['version: "1.2.3"', 'license: "MIT-0"', 'description: "x & y"']
    (pdsc,) = package.glob("*.pdsc")
    assert pdsc.name == "Jane_Doe_Co.axis.pdsc"
    root = ET.fromstring(pdsc.read_text())  # noqa: S314 - our own
    listed = {each.get("name") for each in root.iter("file")}
    assert listed == {"src/axis.h", "src/axis.c"}
    assert root.findtext("vendor") == "Jane_Doe_Co"


def test_zephyr_reads_its_options(package):
    kconfiglib = pytest.importorskip("kconfiglib")
    found = kconfiglib.Kconfig(str(package / "zephyr" / "Kconfig"))
    assert found.syms["AXIS"].type == kconfiglib.BOOL


@pytest.mark.skipif(not (Path(sys.executable).parent / "pio").exists(), reason="no platformio")
def test_platformio_packs_it(package, tmp_path):
    pio = Path(sys.executable).parent / "pio"
    run(pio, "pkg", "pack", package, "-o", tmp_path / "axis.tar.gz", folder=tmp_path)
    assert (tmp_path / "axis.tar.gz").exists()


@needs("mkoctfile")
def test_octave_runs_a_record_with_the_bits_of_python(package, tmp_path):
    import numpy as np

    import fkgen

    run(
        *("mkoctfile", "--mex", f"-I{package / 'src'}", package / "mex" / "axis_mex.c"),
        *(package / "src" / "axis.c", "-o", "axis_mex.mex"),
        folder=tmp_path,
    )
    script = (
        "y = [1; NaN; 0.5; 0.25]; u = [3; 3; 9; 2.5]; r = axis_mex(y, u, [0.25, 2, 0.1]);"
        "printf('%.17g ', r.filtered_state, r.predicted_covariance, r.status)"
    )
    out = run("octave-cli", "--no-gui", "-q", "--eval", script, folder=tmp_path).split()
    spec = tmp_path / "axis.toml"
    spec.write_text(SPEC)
    y, u = np.array([[1], [np.nan], [0.5], [0.25]]), np.array([[3], [3], [9], [2.5]])
    found = fkgen.build(fkgen.load(spec)).run(y, u, {"dt": 0.25, "p": 2.0, "r": 0.1})
    P = found.predicted_covariance[:, [0, 1, 1], [0, 0, 1]]
    values = [found.filtered_state.T.ravel(), P.T.ravel(), found.status]
    np.testing.assert_array_equal(np.array(out, float), np.concatenate(values).astype(float))


@pytest.mark.parametrize(
    ("text", "kinds", "told"),
    [
        (SPEC, "arduino", "package.version: given nothing (the key is missing)"),
        (SPEC + '[package]\nversion = "1.0.0"\n', "cmake,platformio", "package.author: given noth"),
        (SPEC + '[package]\nversion = "1.0"\n', "cmake", "package.version: given '1.0'; expected"),
        (SPEC + "[package]\nauthor = 3\n", "cmake", "package.author: given the int 3"),
        (SPEC, "cmake,meson", "package: given 'meson'; expected one of cmake, arduino"),
        (
            SPEC.replace('"axis"', '"arduino_axis"') + PACKAGE,
            "arduino",
            "name: given 'arduino_axis' for an Arduino library",
        ),
    ],
)
def test_what_a_package_lacks_is_told_and_nothing_is_written(tmp_path, text, kinds, told):
    done = generate(tmp_path, text, kinds, "axis")
    assert done.exit_code == 2
    assert told in done.output
    assert not (tmp_path / "axis").exists()


def test_a_package_is_replaced_but_never_what_was_edited_or_is_of_others(tmp_path):
    assert generate(tmp_path, SPEC, "cmake", "axis").exit_code == 0
    again = generate(tmp_path, SPEC.replace("0.98", "0.97"), "cpp", "axis")
    assert again.exit_code == 0, again.output
    assert "0.97" in (tmp_path / "axis" / "src" / "axis.h").read_text()
    assert (tmp_path / "axis" / "src" / "axis.hpp").exists()
    assert generate(tmp_path, SPEC, "mex", "axis").exit_code == 0
    assert not (tmp_path / "axis" / "CMakeLists.txt").exists()
    source = tmp_path / "axis" / "src" / "axis.c"
    source.write_text(source.read_text() + "\n")
    edited = generate(tmp_path, SPEC, "mex", "axis")
    assert (edited.exit_code, "was edited" in edited.output) == (2, True)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "library.json").write_text("{}")
    taken = generate(tmp_path, SPEC + PACKAGE, "platformio", "own")
    assert (taken.exit_code, "did not write" in taken.output) == (2, True)
    assert [each.name for each in (tmp_path / "own").iterdir()] == ["library.json"]


@needs("cmake")
@pytest.mark.parametrize(
    ("n", "processor", "kind", "chosen"),
    [
        (6, "cortex-m4", "Release", ["-Os"]),
        (6, "arm", "Debug", []),
        (6, "riscv32", "Release", ["-fno-schedule-insns"]),
        (6, "x86_64", "Release", []),
        (5, "cortex-m4", "Release", []),
    ],
)
def test_build_files_choose_the_level_of_a_large_filter(n, processor, kind, chosen, tmp_path):
    units = {f"chain{part}.c": "int chain;\n" for part in ("", "_selftest", "_selftest_main")}
    facts = {"name": "chain", "states": [f"x{i}" for i in range(n)]}
    for name, text in complete(units, facts).items():
        (tmp_path / name).write_text(text)
    cross = ["-DCMAKE_SYSTEM_NAME=Generic", f"-DCMAKE_SYSTEM_PROCESSOR={processor}"]
    cross += ["-DCMAKE_TRY_COMPILE_TARGET_TYPE=STATIC_LIBRARY", f"-DCMAKE_BUILD_TYPE={kind}"]
    cross += ["-DCMAKE_EXPORT_COMPILE_COMMANDS=ON", "-DCMAKE_C_COMPILER=gcc"]
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build", *cross, folder=tmp_path)
    commands = json.loads((tmp_path / "build/compile_commands.json").read_text())
    [words] = [each["command"].split() for each in commands if each["file"].endswith("chain.c")]
    last = words[words.index("-ffp-contract=off") + 1 :]
    assert [word for word in last if word in {"-Os", "-fno-schedule-insns"}] == chosen
