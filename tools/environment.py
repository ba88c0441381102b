"""Set up .venv: ``python3 tools/environment.py run|test|bench|docs``. The Makefile calls it first.

Nothing happens where .venv already holds what is asked for. Otherwise uv does the work, or venv and
pip where there is no uv (or where the variable UV is empty). A stamp, written last, says what .venv
holds and from which pins; a setup that was interrupted is started again from nothing, and a second
one waits for the first.

This runs before anything is installed, and on a Python that may be too old in order to say so:
standard library only, no syntax newer than Python 3.6.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
VENV = ROOT / ".venv"
STAMP = VENV / ".fkgen-setup"
UNFINISHED = VENV / ".fkgen-unfinished"
GROUPS = {"run": [], **{name: ["--group", name] for name in ("test", "bench", "docs")}}
OLDEST = (3, 11)
PROBE = """
import importlib.util, sys
print(*sys.version_info[:3], int(all(map(importlib.util.find_spec, ("venv", "ensurepip")))))
"""


class SetupError(Exception):
    """The machine lacks something; the text says what to do."""


def main(arguments: "list[str]") -> int:
    """Set up what the first argument names; return the exit status."""
    if len(arguments) != 1 or arguments[0] not in GROUPS:
        print("usage: environment.py " + "|".join(GROUPS), file=sys.stderr)
        return 2
    try:
        with locked():
            if arguments[0] not in held_groups():
                set_up(arguments[0])
    except SetupError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    return 0


@contextlib.contextmanager
def locked() -> "Iterator[None]":
    """Let one setup at a time into .venv. Children hold the lock too, should we be killed."""
    with (ROOT / ".venv.lock").open("w") as lock:
        os.set_inheritable(lock.fileno(), True)  # noqa: FBT003  (it takes no keyword)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print("setup: waiting for another one to finish", flush=True)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def held_groups() -> "list[str]":
    """Return the groups that .venv holds by these very pins, in this very place."""
    if UNFINISHED.exists() or not STAMP.exists() or probe(python_of(VENV)) is None:
        return []
    lines = STAMP.read_text().splitlines()
    return ["run", *lines[2:]] if lines[:2] == [str(ROOT), digest()] else []  # all groups run


def digest() -> str:
    """Return the hash of the files that say what is installed."""
    content = b"".join(path.read_bytes() for path in (ROOT / "pyproject.toml", CONSTRAINTS))
    return hashlib.sha256(content).hexdigest()


def set_up(group: str) -> None:
    """Install one group into .venv, which is made anew unless it is sound."""
    start = time.time()
    tool = "uv" if uv() else "pip"
    print(f"setup: {tool} installs pinned packages for {group} into {VENV}, once:", flush=True)
    print("setup: 0.7 GB or more, about half a minute where the network is fast", flush=True)
    if not is_sound():
        shutil.rmtree(str(VENV), ignore_errors=True)
        VENV.mkdir()
        UNFINISHED.touch()
        create(VENV)
    held = sorted({*held_groups(), group})
    UNFINISHED.touch()
    install(VENV, ["--editable", str(ROOT), *GROUPS[group]])
    STAMP.write_text("\n".join([str(ROOT), digest(), *held]) + "\n")
    UNFINISHED.unlink()
    print(f"setup: done in {time.time() - start:.0f} s", flush=True)


def is_sound() -> bool:
    """Say whether .venv can be built upon: finished, made here, new enough, able to install."""
    found = probe(python_of(VENV))
    moved = STAMP.exists() and STAMP.read_text().splitlines()[:1] != [str(ROOT)]
    if UNFINISHED.exists() or moved or found is None or found[0] < OLDEST:
        return False
    return bool(uv()) or quiet([python_of(VENV), "-m", "pip", "--version"]) is not None


def create(venv: Path) -> None:
    """Make an empty virtual environment in a folder that may exist."""
    if uv():
        python = find_python()
        if python is None:
            print(f"setup: no Python {text(OLDEST)} or newer here, uv looks for one", flush=True)
            python = f">={text(OLDEST)}"
        run([uv(), "venv", "--quiet", "--allow-existing", "--python", python, str(venv)])
    else:
        run([str(find_python()), "-m", "venv", str(venv)])


def install(venv: Path, what: "list[str]") -> None:
    """Install with the pinned versions, the build backend's included."""
    python = python_of(venv)
    pins = ["--constraint", str(CONSTRAINTS)]
    if uv():
        build_pins = ["--build-constraints", str(CONSTRAINTS)]
        command = [uv(), "pip", "install", "--quiet", "--python", python]
    else:
        build_pins = ["--build-constraint", str(CONSTRAINTS)]
        command = [python, "-m", "pip", "install", "--quiet"]
        run([*command, *pins, "pip"])  # the pinned one knows groups and build constraints
    run([*command, *pins, *build_pins, *what])


def find_python() -> "str | None":
    """Return a Python that is new enough: the one that runs this, or a versioned one of PATH.

    None leaves the search to uv.
    """
    own = getattr(sys, "_base_executable", sys.executable)  # not the one inside .venv
    names = [own] + [f"python3.{minor}" for minor in range(14, OLDEST[1] - 1, -1)]
    found = [(name, probe(name)) for name in names]
    fitting = [(name, *facts) for name, facts in found if facts and facts[0] >= OLDEST]
    for name, _, has_venv in fitting:
        if uv() or has_venv:
            return name
    if uv():
        return None
    if fitting:
        name, (major, minor, _), _ = fitting[0]
        raise SetupError(
            f"{name} cannot make virtual environments. On Debian and Ubuntu: "
            f"apt install python3-venv (or python{major}.{minor}-venv)"
        )
    raise SetupError(
        f"fkgen needs Python {text(OLDEST)} or newer, {own} is {text(sys.version_info[:3])}. "
        "Install a newer one, or name it: make PYTHON=/path/to/python3"
    )


def text(version: "tuple[int, ...]") -> str:
    """Write a version the usual way."""
    return ".".join(map(str, version))


def probe(python: str) -> "tuple[tuple[int, ...], bool] | None":
    """Return (version, can make environments) of a Python, None if it does not run."""
    facts = quiet([python, "-c", PROBE])
    if facts is None:
        return None
    *version, has_venv = map(int, facts.split())
    return tuple(version), bool(has_venv)


def python_of(venv: Path) -> str:
    """Return the interpreter of a virtual environment."""
    return str(venv / "bin" / "python")


def uv() -> str:
    """Return the path of uv, empty if there is none or none is wanted."""
    return shutil.which(os.environ.get("UV", "uv") or "none") or ""


def quiet(command: "list[str]") -> "str | None":
    """Return what a command prints, None if it fails."""
    try:
        return subprocess.check_output(
            command, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL
        ).decode()
    except (OSError, subprocess.CalledProcessError):
        return None


def run(command: "list[str]") -> None:
    """Run a command that has to succeed."""
    try:
        subprocess.run(command, check=True, stdin=subprocess.DEVNULL, close_fds=False)
    except (OSError, subprocess.CalledProcessError) as error:
        raise SetupError(f"this failed: {' '.join(command)}") from error


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
