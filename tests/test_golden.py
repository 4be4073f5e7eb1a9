"""Presets of the paper and its code keep their results to the bit."""

from __future__ import annotations

import json
from typing import Any

import pytest

import golden

GOLDEN = json.loads(golden.FILE.read_text())
CASES = dict(golden.cases())


@pytest.mark.skipif(GOLDEN["processor"] != golden.processor(), reason="made on another processor")
@pytest.mark.parametrize("name", CASES)
def test_results_keep_their_bits(name: str) -> None:
    digests: dict[str, Any] = CASES[name]()
    expected = GOLDEN["cases"][name]
    # A new quantity of a result has no digest in the file.
    assert {quantity: digests.get(quantity) for quantity in expected} == expected
