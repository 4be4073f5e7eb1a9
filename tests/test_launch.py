"""Bound kernels: arguments, arrays, messages, and the switch to Taichi's public interface."""

import gc
import os
import subprocess
import sys
import weakref
from typing import Any, no_type_check

import numpy as np
import pytest
import taichi as ti
from taichi._lib import core
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder
from taichi.lang.exception import TaichiCompilationError

from sdc_taichi import ConfigError
from sdc_taichi.kernels.compiler.arrays import aligned
from sdc_taichi.kernels.compiler.launch import OPTIONS, BoundKernel
from sdc_taichi.kernels.compiler.runtime import ensure_started, uses_plain_taichi

VECTORS = ti.types.ndarray(dtype=ti.types.vector(4, ti.f64), ndim=1)
NUMBERS = ti.types.ndarray(dtype=ti.f64, ndim=1)


@pytest.fixture(autouse=True)
def _started() -> None:
    ensure_started()


@ti.kernel
@no_type_check
def add_scaled(negative: ti.template(), factor: ti.f64, x: VECTORS, out: VECTORS):
    for i in range(x.shape[0]):
        if ti.static(negative):
            out[i] = out[i] - factor * x[i]
        else:
            out[i] = out[i] + factor * x[i]


@ti.func
@no_type_check
def _faulty(x):
    return x + np.nowhere


def vectors(values: float) -> Any:
    out = aligned((3, 4), np.float64)
    out[:] = values
    return out


def test_every_call_takes_its_own_arguments() -> None:
    kernel = BoundKernel(add_scaled, templates=1)
    x, y, out = vectors(1.0), vectors(10.0), vectors(0.0)
    kernel(False, 2.0, x, out)
    kernel(False, 3.0, y, out)
    kernel(True, 1.0, x, out)
    assert np.all(out == 2.0 + 30.0 - 1.0)
    other = vectors(5.0)
    kernel(False, 3.0, x, other)
    assert np.all(other == 8.0)
    assert np.all(out == 31.0)


@pytest.mark.skipif(uses_plain_taichi(), reason="checks of plain Taichi are its own")
def test_arrays_that_do_not_fit_are_refused() -> None:
    kernel = BoundKernel(add_scaled, templates=1)
    x, out = vectors(1.0), vectors(0.0)
    kernel(False, 1.0, x, out)
    wrong = (x.astype(np.float32), x[0], np.repeat(x, 2, axis=1)[:, ::2])
    unaligned = aligned((16,), np.float64)[1:13].reshape(3, 4)
    for array, match in (
        *((array, "other type or order") for array in wrong),
        (unaligned, "start at whole ones"),
    ):
        with pytest.raises(TypeError, match=match):
            kernel(False, 1.0, array, out)
    assert np.all(out == 1.0)


def test_released_arrays_are_not_kept() -> None:
    kernel = BoundKernel(add_scaled, templates=1)
    x, out = vectors(1.0), vectors(0.0)
    left = weakref.ref(x.base)
    kernel(False, 1.0, x, out)
    kernel(True, 1.0, x, out)
    kernel.release(x)
    del x
    gc.collect()
    assert left() is None


def test_an_error_says_where_it_is_and_leaves_taichi_as_it_was() -> None:
    @ti.kernel
    @no_type_check
    def wrong(x: NUMBERS):
        for i in range(1):
            x[i] = _faulty(x[i])

    def replaced() -> list[Any]:
        return [Builder.__call__, ASTTransformerContext.get_pos_info, core.DebugInfo]

    options, before = {name: getattr(ti.cfg, name) for name in OPTIONS}, replaced()
    with pytest.raises(TaichiCompilationError, match=r"test_launch\.py.*in _faulty:\s+return x \+"):
        BoundKernel(wrong, 0)(np.zeros(1))
    assert {name: getattr(ti.cfg, name) for name in OPTIONS} == options
    assert replaced() == before
    # Taichi's own message marks the columns.
    with pytest.raises(TaichiCompilationError, match=r"in _faulty:\s+return x \+.*\n\s+\^+"):
        wrong(np.zeros(1))


def test_results_are_the_same_bits_through_the_public_interface(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = """
import hashlib, sdc_taichi
values = ["simulation.thermal=transient", "hvac.crac.units=2"]
with sdc_taichi.Simulator(sdc_taichi.load_config("corrected", values)) as sim:
    sim.reset(seed=0)
    for _ in range(3):
        result = sim.step()
        layers = sim.servers()
names = "it_w", "grid_kwh", "queue_tasks", "rack_inlet_c"
print(*(getattr(result, name).tobytes().hex() for name in names))
print(hashlib.sha256(layers.inlet_c.tobytes() + layers.power_w.tobytes()).hexdigest())
"""
    exec(code, {})
    here = capsys.readouterr().out
    plain = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "SDC_TAICHI_PLAIN": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    ).stdout
    assert here == plain
    assert len(here.split()) == 5


def test_the_switch_is_0_or_1(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, plain in (("", False), ("0", False), ("1", True)):
        monkeypatch.setenv("SDC_TAICHI_PLAIN", text)
        assert uses_plain_taichi() == plain
    monkeypatch.setenv("SDC_TAICHI_PLAIN", "yes")
    with pytest.raises(ConfigError, match="SDC_TAICHI_PLAIN='yes': valid are 0 and 1"):
        BoundKernel(add_scaled, templates=1)
