"""Compare generated/ with what fkgen generates now, or write it anew.

    python tools/golden.py              says what differs; exit status 1 if anything does
    python tools/golden.py --update     writes; read the diff before you commit it

Every examples/*/*.toml is a spec with a folder generated/<name>/.
"""

from __future__ import annotations

import argparse
import difflib
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import fkgen

ROOT = Path(__file__).resolve().parents[1]
GENERATED = ROOT / "generated"

#: Characters of a filter beyond which its header and the digests of its manifest stand for it.
HEAVY = 300_000


def current() -> dict[str, dict[str, str]]:
    """Files by folder, as fkgen generates them now."""
    result = {}
    for path in sorted((ROOT / "examples").glob("*/*.toml")):
        spec = fkgen.load(path)
        if spec.name in result:
            raise SystemExit(f"{path.relative_to(ROOT)}: the name {spec.name} is taken")
        result[spec.name] = kept(fkgen.generate(fkgen.validate(spec)).files)
    return result


def kept(files: Mapping[str, str]) -> dict[str, str]:
    """What stands in generated/: of a heavy filter its header, and the digests of the rest."""
    if sum(map(len, files.values())) <= HEAVY:
        return dict(files)
    return {name: text for name, text in files.items() if name.endswith((".h", ".json"))}


def committed() -> dict[str, dict[str, str]]:
    """Files by folder, as they stand in generated/."""
    folders = sorted(path for path in GENERATED.glob("*") if path.is_dir())
    return {
        folder.name: {
            path.name: path.read_text(encoding="utf-8") for path in sorted(folder.iterdir())
        }
        for folder in folders
    }


def differences() -> Iterator[str]:
    """Unified diffs from what is committed to what fkgen generates."""
    old, new = committed(), current()
    for folder in sorted(old.keys() | new.keys()):
        before, after = old.get(folder, {}), new.get(folder, {})
        for name in sorted(before.keys() | after.keys()):
            place = f"generated/{folder}/{name}"
            lines = [side.get(name, "").splitlines(keepends=True) for side in (before, after)]
            yield from difflib.unified_diff(*lines, f"{place} (committed)", f"{place} (now)")


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(description="compare or update generated/")
    parser.add_argument("--update", action="store_true", help="write generated/ anew")
    if parser.parse_args().update:
        new = current()  # all of it, before anything goes
        for folder in committed():
            shutil.rmtree(GENERATED / folder)
        for folder, files in new.items():
            (GENERATED / folder).mkdir(parents=True)
            for name, text in files.items():
                (GENERATED / folder / name).write_text(text, encoding="utf-8", newline="\n")
        return 0
    diff = list(differences())
    sys.stdout.writelines(diff[:400])
    if diff:
        print("\ngenerated/ is not what fkgen generates. If the change is meant: make golden")
    return 1 if diff else 0


if __name__ == "__main__":
    sys.exit(main())
