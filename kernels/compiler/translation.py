"""Translation of the source of kernels by Taichi, which every start does, in a quarter of the time.

Taichi keeps compiled kernels, but knows them by what their source is translated to.
"""

import linecache
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from taichi._lib import core
from taichi.lang import expr, impl, kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder
from taichi.types import primitive_types

MOST_I32 = 2**31 - 1


@contextmanager
def replaced(*places: tuple[Any, str, Any]) -> Iterator[None]:
    """Attributes of objects meanwhile: object, name and value of each."""
    before = [getattr(owner, name) for owner, name, _ in places]
    try:
        for owner, name, value in places:
            setattr(owner, name, value)
        yield
    finally:
        for (owner, name, _), value in zip(places, before, strict=True):
            setattr(owner, name, value)


def translate(kernel: Any, args: tuple[Any, ...]) -> Any:
    """Translate a kernel for such arguments; return the key by which Taichi finds it.

    Whole numbers have 32 bits, whatever whoever started the runtime chose.
    """
    with replaced((impl.get_runtime(), "default_ip", primitive_types.i32)):
        try:
            with _in_short():
                return kernel.ensure_compiled(*args)
        except Exception:
            # Once more for the message, which has an excerpt of the source.
            return kernel.ensure_compiled(*args)


_read = kernel_impl.getsourcelines


def _source(function: Any) -> tuple[list[str], int]:
    """As `inspect`, which looks for the end of a function word by word."""
    code = function.__code__
    first = code.co_firstlineno
    ends = [end for _, end, column, _ in code.co_positions() if end and column is not None]
    if not ends:  # as with `python -X no_debug_ranges`
        found: tuple[list[str], int] = _read(function)
        return found
    lines = linecache.getlines(code.co_filename, function.__globals__)
    return lines[first - 1 : max(ends)], first


def _unbroken(line: str, **_: Any) -> str:
    """As `textwrap` for lines of up to 9,999 letters."""
    return line.rstrip()


def _build(self: Any, context: Any, node: Any) -> Any:
    """Translate a node without a word on where it is, which takes half of the time."""
    return getattr(self, f"build_{type(node).__name__}")(context, node)


@contextmanager
def _in_short() -> Iterator[None]:
    """Leave out of the translation what is for messages alone, and what was done before."""
    runtime = impl.get_runtime()
    config, nowhere = runtime.prog.config(), core.DebugInfo("")
    expression, constant, variable = expr.Expr, expr.make_constant_expr, impl.expr_init
    of_any, parse = expression.__init__, kernel_impl._get_tree_and_ctx
    transform, dedent = kernel_impl.transform_tree, kernel_impl.textwrap.dedent
    parsed: dict[Any, list[tuple[Any, Any]]] = defaultdict(list)

    def init(self: Any, *args: Any, dbg_info: Any = None, dtype: Any = None) -> None:
        if type(args[0]) is not core.Expr:
            of_any(self, *args, dbg_info=dbg_info, dtype=dtype)
            return
        self.dbg_info, self.ptr, self.ptr_type_checked = dbg_info, args[0], True
        self.ptr.type_check(config)

    def constant_of(value: Any, dtype: Any) -> Any:
        if type(value) is int and dtype is None and abs(value) <= MOST_I32:
            return expression(core.make_const_expr_int(primitive_types.i32, value))
        return constant(value, dtype)

    def variable_of(value: Any) -> Any:
        if type(value) is not expression:
            return variable(value)
        builder = runtime.compiling_callable.ast_builder()
        return expression(builder.expr_var(value.ptr, nowhere))

    def tree_of(self: Any, is_kernel: bool = True, **options: Any) -> Any:
        if is_kernel or not parsed[self.func]:
            return parse(self, is_kernel=is_kernel, **options)
        tree, last = parsed[self.func].pop()
        return tree, ASTTransformerContext(
            is_kernel=False,
            func=self,
            global_vars=last.global_vars,
            argument_data=options["args"],
            file=last.file,
            src=last.src,
            start_lineno=last.lineno_offset + 1,
            ast_builder=options["ast_builder"],
        )

    def transform_once(tree: Any, context: Any) -> Any:
        # A tree holds what its nodes came to, so it serves one call at a time.
        found = transform(tree, context)
        parsed[context.func.func].append((tree, context))
        return found

    with replaced(
        (Builder, "__call__", _build),
        (ASTTransformerContext, "get_pos_info", lambda *_: ""),
        (core, "DebugInfo", lambda *_: nowhere),
        (runtime, "src_info_stack", [""]),
        (expression, "__init__", init),
        (expr, "make_constant_expr", constant_of),
        (impl, "expr_init", variable_of),
        (kernel_impl, "_get_tree_and_ctx", tree_of),
        (kernel_impl, "transform_tree", transform_once),
        (kernel_impl, "getsourcelines", _source),
        (kernel_impl, "textwrap", SimpleNamespace(fill=_unbroken, dedent=dedent)),
    ):
        yield
