"""Every test builds its filters in a cache of this test session, never in the user's."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True, scope="session")
def session_cache(tmp_path_factory):
    """Set FKGEN_CACHE to one folder for all workers of this run: entries are named by content."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FKGEN_CACHE", str(base / "fkgen-cache"))
        patch.setenv("FKGEN_CFLAGS", os.environ.get("FKGEN_CFLAGS", "-O1"))
        yield base / "fkgen-cache"
