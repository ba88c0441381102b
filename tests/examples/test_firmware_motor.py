"""The firmware of examples/firmware_motor, from reset to exit, with the bits of the host."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

from fkgen.target import toolchain

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "firmware_motor"


def test_the_firmware_runs_and_the_page_says_what_it_prints(capsys, monkeypatch):
    spec = importlib.util.spec_from_file_location("firmware_motor", EXAMPLE / "run.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    if shutil.which("arm-none-eabi-gcc"):
        assert script.main() == 0
        page = (EXAMPLE / "README.md").read_text(encoding="utf-8")
        _, *lines = capsys.readouterr().out.splitlines()  # sizes are the compiler's
        assert all(f"    {line}\n" in page for line in lines)
    found = shutil.which
    without = lambda name: None if "-gcc" in name else found(name)  # noqa: E731
    monkeypatch.setattr(toolchain.shutil, "which", without)
    assert script.main() == 0
    told = capsys.readouterr().out
    assert "1000 samples, 50 of them out of range" in told
    assert "the same bits as on this machine: yes" in told
