"""Check what users install: ``python tools/wheel_check.py``.

Builds the sdist and from it the wheel, installs the wheel into an empty environment far from the
checkout and uses it from yet another folder: with the compilers of the machine, with none at all,
and with the one that the extra ``zig`` brings.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

import environment

COMPILERS = ("cc", "gcc", "clang")
FAMILIES = ("kf", "mkf", "mme")
SHIPPED = ("fkgen/templates/", "fkgen/examples/dc_motor/", "fkgen/examples/car_speed/")
USER_ERROR = 2
PATIENCE = 300  # s; zig takes about 15 s for its first compilation


class CheckError(Exception):
    """The wheel does not do what it should."""


@dataclass(frozen=True)
class Installed:
    """The wheel in an environment of its own, under a folder that nobody else uses."""

    venv: Path
    folder: Path

    def fkgen(self, *arguments: str, path: str, status: int = 0) -> str:
        """Run the command in an empty folder with an empty home; return all it printed."""
        start = time.monotonic()
        home = Path(tempfile.mkdtemp(dir=self.folder))  # empty, so that no cache helps
        done = subprocess.run(
            [self.venv / "bin" / "fkgen", *arguments],
            cwd=home,
            env={"HOME": str(home), "TMPDIR": str(home), "PATH": path, "LANG": "C.UTF-8"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        call = " ".join(("fkgen", *arguments))
        if done.returncode != status or "Traceback" in done.stdout:
            raise CheckError(f"{call}: status {done.returncode}, not {status}:\n{done.stdout}")
        print(f"  {call}: status {status} ({time.monotonic() - start:.1f} s)", flush=True)
        return done.stdout


def main() -> int:
    """Run all checks; return the exit status."""
    with tempfile.TemporaryDirectory(prefix="fkgen-wheel-") as folder:
        try:
            check(Path(folder))
        except (CheckError, environment.SetupError, subprocess.SubprocessError) as error:
            print(f"wheel check: {error}", file=sys.stderr)
            return 1
    print("wheel check: all is well")
    return 0


def check(folder: Path) -> None:
    """Build, install, use."""
    wheel = build(folder / "dist")
    installed = Installed(folder / "venv", folder)
    environment.create(installed.venv)
    environment.install(installed.venv, [str(wheel)])
    own = str(installed.venv / "bin")  # no other program in PATH

    print("with the compilers of this machine")
    check_anywhere(installed, os.pathsep.join((own, os.environ["PATH"])))
    print("with no compiler")
    check_without_compiler(installed, own)
    print("with the compiler of fkgen[zig]")
    environment.install(installed.venv, [f"{wheel}[zig]"])
    installed.fkgen("demo", path=own)


def build(folder: Path) -> Path:
    """Build both archives with the pinned backend; return the wheel."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder)]
    subprocess.run([*command, str(environment.ROOT)], check=True, stdout=subprocess.DEVNULL)
    for archive in sorted(folder.iterdir()):
        print(f"{archive.name}: {archive.stat().st_size / 1000:.0f} kB")
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        names = content.namelist()
    missing = [start for start in SHIPPED if not any(name.startswith(start) for name in names)]
    if missing:
        raise CheckError(f"the wheel lacks {', '.join(missing)}")
    strays = [name for name in names if not name.startswith(("fkgen/", "fkgen-"))]
    if strays:
        raise CheckError(f"the wheel holds {', '.join(strays)}")
    return wheel


def check_anywhere(installed: Installed, path: str) -> None:
    """Use the command outside the checkout, the demo too where there is a compiler."""
    installed.fkgen("--help", path=path)
    listing = installed.fkgen("families", path=path)
    missing = [family for family in FAMILIES if family not in listing.split()]
    if missing:
        raise CheckError(f"fkgen families does not list {', '.join(missing)}:\n{listing}")
    if any(shutil.which(compiler) for compiler in COMPILERS):
        installed.fkgen("demo", path=path)
    else:
        print("  fkgen demo: left out, this machine has no compiler")


def check_without_compiler(installed: Installed, path: str) -> None:
    """Expect the demo to end as a user's mistake does, and to say what is missing."""
    text = installed.fkgen("demo", path=path, status=USER_ERROR)
    if "compiler" not in text:
        raise CheckError(f"fkgen demo does not say that a compiler is missing:\n{text}")
    print("    " + text.strip().splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
