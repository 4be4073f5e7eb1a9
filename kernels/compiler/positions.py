"""Translation of kernels without positions in the source, which Taichi keeps for messages alone."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import taichi as ti
from taichi._lib import core
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder


@contextmanager
def no_positions() -> Iterator[None]:
    """Replace what finds, formats and passes on the position of every node, and put it back."""
    nowhere = core.DebugInfo("")
    places: tuple[tuple[Any, str, Any], ...] = (
        (Builder, "__call__", _build),
        (ASTTransformerContext, "get_pos_info", lambda *_: ""),
        (core, "DebugInfo", lambda *_: nowhere),
        (ti.lang.impl.get_runtime(), "src_info_stack", [""]),
    )
    before = [getattr(owner, name) for owner, name, _ in places]
    try:
        for owner, name, value in places:
            setattr(owner, name, value)
        yield
    finally:
        for (owner, name, _), value in zip(places, before, strict=True):
            setattr(owner, name, value)


def _build(builder: Any, context: Any, node: Any) -> Any:
    """Translate a node; its errors are found again, with positions, by a second translation."""
    return getattr(builder, f"build_{type(node).__name__}")(context, node)
