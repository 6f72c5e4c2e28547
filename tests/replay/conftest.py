"""Every store of the replay."""

from __future__ import annotations

import pytest
from streams import STORES


@pytest.fixture(params=STORES)
def store(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return STORES[request.param]
