"""Scripts of an example as modules, whatever other examples call theirs."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@contextmanager
def scripts_of(example, *names):
    """Import scripts of an example; afterwards no module of it is left behind."""
    folder = EXAMPLES / example
    own = [path.stem for path in folder.glob("*.py")]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        for name in own:
            patch.delitem(sys.modules, name, raising=False)
        try:
            yield [import_module(name) for name in names]
        finally:
            for name in own:
                sys.modules.pop(name, None)
