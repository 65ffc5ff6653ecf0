"""Code generation from traced expressions: exact derivatives, and compiled straight-line functions."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any, TypeVar

from control.kinematics.tracing import FUNCTIONS, Scalar, Symbol, cos, sin

Owner = TypeVar("Owner")
Built = TypeVar("Built")
KEPT = 64  # compiled functions of each sort


def shared(build: Callable[[Owner], Built]) -> "cached_property[Built]":
    """A property that is built once for all equal owners: to trace and compile takes longer than most uses."""
    return cached_property(lru_cache(maxsize=KEPT)(build))


def derivative(outputs: Sequence[Scalar], variable: Symbol) -> list[Scalar]:
    """Return the exact derivatives of traced outputs by one variable (forward mode over the graph)."""
    known: dict[int, Scalar] = {variable.number: 1.0}
    for node in _in_order(outputs):
        if node.number not in known:
            known[node.number] = _rule(node, [_known(known, a) for a in node.arguments])
    return [_known(known, output) for output in outputs]


def _known(known: dict[int, Scalar], a: Scalar) -> Scalar:
    return known[a.number] if isinstance(a, Symbol) else 0.0


def _rule(node: Symbol, d: list[Scalar]) -> Scalar:
    """The derivative of one operation from those of its arguments."""
    a = node.arguments
    if node.operation == "variable":
        return 0.0
    if node.operation == "+":
        return d[0] + d[1]
    if node.operation == "-":
        return d[0] - d[1]
    if node.operation == "negate":
        return -d[0]
    if node.operation == "*":
        return d[0] * a[1] + a[0] * d[1]
    if node.operation == "/":
        return (d[0] - node * d[1]) / a[1]
    if node.operation == "sin":
        return cos(a[0]) * d[0]
    if node.operation == "cos":
        return -sin(a[0]) * d[0]
    raise NotImplementedError(f"no derivative of {node.operation}")


def _in_order(outputs: Sequence[Scalar]) -> Iterator[Symbol]:
    """Yield every node that the outputs need, in topological order."""
    seen: set[int] = set()
    stack: list[tuple[Symbol, bool]] = [(o, False) for o in reversed(outputs) if isinstance(o, Symbol)]
    while stack:
        node, is_ready = stack.pop()
        if is_ready:
            yield node
        elif node.number not in seen:
            seen.add(node.number)
            stack.append((node, True))
            stack.extend((a, False) for a in reversed(node.arguments) if isinstance(a, Symbol))


def compile_function(
    name: str, inputs: Sequence[Symbol | Sequence[Symbol]], outputs: Any, library: Any = math
) -> Callable[..., Any]:
    """Return the traced function, compiled.

    `inputs` are positional arguments; a sequence of symbols is one argument that is unpacked. `outputs` is a
    symbol, a number, or a nested tuple of them, returned in that shape. `library` gives sin and cos: math for
    scalars, numpy for arrays.
    """
    source = function_source(name, inputs, outputs)
    scope: dict[str, Any] = {f"_{function}": getattr(library, function) for function in FUNCTIONS}
    exec(
        compile(source, f"<traced {name}>", "exec"), scope
    )  # the source is generated from numbers and names only
    function: Callable[..., Any] = scope[name]
    return function


def function_source(name: str, inputs: Sequence[Symbol | Sequence[Symbol]], outputs: Any) -> str:
    """Return the Python source of a traced function: one assignment for each value that is used twice."""
    flat = list(_flat(outputs))
    uses = _uses(flat)
    text: dict[int, str] = {}
    used = sorted({node.operation for node in _in_order(flat)} & FUNCTIONS)
    bound = [f"{function}=_{function}" for function in used]  # local lookups are faster than global ones
    lines = [f"def {name}({', '.join([*_parameters(inputs), *bound])}):"]
    lines += [
        f"    {', '.join(s.name for s in group)}, = a{i}"
        for i, group in enumerate(inputs)
        if not isinstance(group, Symbol)
    ]
    for node in _in_order(flat):
        expression = _expression(node, text)
        if uses[node.number] > 1 and node.operation != "variable":
            lines.append(f"    v{node.number} = {expression}")
            expression = f"v{node.number}"
        text[node.number] = expression
    lines.append(f"    return {_returned(outputs, text)}")
    return "\n".join(lines) + "\n"


def _parameters(inputs: Sequence[Symbol | Sequence[Symbol]]) -> list[str]:
    return [group.name if isinstance(group, Symbol) else f"a{i}" for i, group in enumerate(inputs)]


def _flat(outputs: Any) -> Iterator[Scalar]:
    if isinstance(outputs, tuple | list):
        for output in outputs:
            yield from _flat(output)
    else:
        yield outputs


def _uses(outputs: Sequence[Scalar]) -> dict[int, int]:
    uses: dict[int, int] = {}
    for node in [*_in_order(outputs)]:
        for a in node.arguments:
            if isinstance(a, Symbol):
                uses[a.number] = uses.get(a.number, 0) + 1
    for output in outputs:
        if isinstance(output, Symbol):
            uses[output.number] = uses.get(output.number, 0) + 1
    return uses


def _expression(node: Symbol, text: dict[int, str]) -> str:
    operands = [text[a.number] if isinstance(a, Symbol) else repr(float(a)) for a in node.arguments]
    if node.operation == "variable":
        return node.name
    if node.operation in FUNCTIONS:
        return f"{node.operation}({', '.join(operands)})"
    if node.operation == "negate":
        return f"(-{operands[0]})"
    return f"({operands[0]} {node.operation} {operands[1]})"


def _returned(outputs: Any, text: dict[int, str]) -> str:
    if isinstance(outputs, tuple | list):
        inner = ", ".join(_returned(output, text) for output in outputs)
        return f"({inner},)" if outputs else "()"
    return text[outputs.number] if isinstance(outputs, Symbol) else repr(float(outputs))
