"""Translation of kernels: what Taichi does otherwise, with less work, and messages all the same."""

import ast
import gc
import subprocess
import sys
from collections import Counter
from typing import Any, no_type_check

import numpy as np
import pytest
from taichi._lib import core
from taichi.lang import expr, impl, kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder
from taichi.lang.exception import TaichiCompilationError

from sdc_taichi.kernels.compiler import collector
from sdc_taichi.kernels.compiler.backend import BoundKernel, func, kernel, ti
from sdc_taichi.kernels.compiler.runtime import ensure_started

ARRAY = ti.types.ndarray(dtype=ti.f64, ndim=1)


@func
@no_type_check
def _halved(x):
    return x * ti.f64(0.5)


@func
@no_type_check
def _reduced(x, times: ti.template()):
    out = _halved(x)
    if ti.static(times > 1):
        out = _reduced(_halved(x) + 0 * out, times - 1) - ti.f64(0.0)
    return out


@func
@no_type_check
def _faulty(x):
    return x + np.nowhere


@pytest.fixture(autouse=True)
def _started() -> None:
    ensure_started()


def _state() -> list[Any]:
    """What the translation replaces."""
    return [
        Builder.__call__,
        ASTTransformerContext.get_pos_info,
        core.DebugInfo,
        list(impl.get_runtime().src_info_stack),
        impl.get_runtime().default_ip,
        expr.Expr.__init__,
        expr.make_constant_expr,
        impl.expr_init,
        kernel_impl._get_tree_and_ctx,
        kernel_impl.transform_tree,
        kernel_impl.getsourcelines,
        kernel_impl.textwrap,
    ]


def test_a_function_is_parsed_once_for_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    @kernel
    @no_type_check
    def many(x: ARRAY):
        ti.loop_config(serialize=True)
        for i in range(1):
            x[i] = _halved(_halved(x[i])) + _halved(_halved(_halved(x[i])))

    parsed: Counter[str] = Counter()
    parse = ast.parse

    def counted(text: str, *args: Any, **options: Any) -> Any:
        tree = parse(text, *args, **options)
        parsed[next(n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))] += 1
        return tree

    monkeypatch.setattr(ast, "parse", counted)
    x = np.array([8.0])
    BoundKernel(many, 0)(x)
    assert parsed == {"many": 1, "_halved": 1}
    assert x == 3.0


def test_a_function_may_call_itself() -> None:
    @kernel
    @no_type_check
    def deep(x: ARRAY):
        ti.loop_config(serialize=True)
        for i in range(1):
            x[i] = _reduced(x[i], 4)

    x = np.array([16.0])
    BoundKernel(deep, 0)(x)
    assert x == 1.0


def test_an_error_says_where_it_is_and_leaves_taichi_as_it_was() -> None:
    @kernel
    @no_type_check
    def wrong(x: ARRAY):
        ti.loop_config(serialize=True)
        for i in range(1):
            x[i] = _faulty(x[i])

    before = _state()
    excerpt = r"test_translation\.py.*in _faulty[^^]*x \+ np\.nowhere"
    with pytest.raises(TaichiCompilationError, match=excerpt):
        BoundKernel(wrong, 0)(np.zeros(1))
    assert _state() == before
    assert not impl.get_runtime().inside_kernel


def test_collections_pause_and_go_on() -> None:
    ended: list[str] = []

    def note(phase: str, _: dict[str, int]) -> None:
        ended.append(phase)

    gc.callbacks.append(note)
    try:
        with collector.paused():
            assert not gc.isenabled()
            with collector.paused():
                kept: list[list[int]] = [[] for _ in range(10_000)]
            assert not gc.isenabled()
        young = gc.get_count()[0]
    finally:
        gc.callbacks.remove(note)
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert young < len(kept)
    assert not ended


def test_a_start_is_not_searched_for_garbage() -> None:
    code = """
import gc, sdc_taichi
env = sdc_taichi.parallel_env("corrected")
env.reset(seed=0)
env.step(dict.fromkeys(env.possible_agents, 1))
print(sum(generation["collections"] for generation in gc.get_stats()), gc.isenabled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    collections, enabled = done.stdout.split()
    assert int(collections) < 120
    assert enabled == "True"
