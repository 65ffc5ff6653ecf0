"""Traces textbook functions on symbols, so that they can be compiled to straight-line Python.

A generic function uses `+ - * /` and the `sin`, `cos` of this module; it runs on floats, on numpy arrays, and
on symbols. On symbols, constants are folded (0, 1, -1 and multiples of pi/2 leave no operation
behind) and equal sub-expressions are shared (hash-consing); `control.kinematics.tracing` generates the code. Constants
are never rounded: only a multiple of pi/2 to the last bit of a double counts as one, so calibrated values are
kept exactly.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any, Final, TypeVar

import numpy as np

Scalar = Any  # float, numpy array or Symbol: arguments of generic functions
FUNCTIONS: Final = frozenset({"sin", "cos", "sqrt", "acos", "atan2"})
_EXACT_ANGLE: Final = 1e-15  # rad; the double nearest to pi/2 is 6e-17 off, the one nearest to 2 pi 2.5e-16


def sin(x: Scalar) -> Scalar:
    """Sine of a float, an array or a symbol."""
    if isinstance(x, Symbol):
        return x.graph.trigonometric("sin", x)
    if isinstance(x, float | int):
        return _exact_sin(x)
    return np.sin(x)


def cos(x: Scalar) -> Scalar:
    """Cosine of a float, an array or a symbol."""
    if isinstance(x, Symbol):
        return x.graph.trigonometric("cos", x)
    if isinstance(x, float | int):
        return _exact_sin(x, 1)
    return np.cos(x)


def sqrt(x: Scalar) -> Scalar:
    """Square root of a float, an array or a symbol."""
    return _called("sqrt", x)


def acos(x: Scalar) -> Scalar:
    """Arc cosine of a float, an array or a symbol."""
    return _called("acos", x)


def atan2(y: Scalar, x: Scalar) -> Scalar:
    """Angle of (x, y), of floats, arrays or symbols."""
    return _called("atan2", y, x)


def _called(function: str, *arguments: Scalar) -> Scalar:
    for argument in arguments:
        if isinstance(argument, Symbol):
            return argument.graph.call(function, arguments)
    is_batch = any(isinstance(argument, np.ndarray) for argument in arguments)
    return getattr(np if is_batch else math, function)(*arguments)


def quarter_turns(angle_rad: float) -> int | None:
    """Return k if an angle is k pi/2 to the last bit, else None."""
    k = round(angle_rad / (math.pi / 2))
    return k if abs(angle_rad - k * (math.pi / 2)) <= _EXACT_ANGLE else None


def _exact_sin(x: float, quarters: int = 0) -> float:
    k = quarter_turns(x)
    if k is not None:
        return (0.0, 1.0, 0.0, -1.0)[(k + quarters) % 4]
    return math.cos(x) if quarters else math.sin(x)


class Symbol:
    """A node of the expression graph; equal expressions of one graph are the same object."""

    __slots__ = ("arguments", "graph", "name", "number", "operation")

    def __init__(self, graph: "Graph", number: int, operation: str, arguments: tuple[Any, ...], name: str = "") -> None:
        self.graph = graph
        self.number = number
        self.operation = operation
        self.arguments = arguments
        self.name = name

    def __add__(self, other: Scalar) -> Scalar:
        return self.graph.add(self, other)

    __radd__ = __add__

    def __sub__(self, other: Scalar) -> Scalar:
        return self.graph.subtract(self, other)

    def __rsub__(self, other: Scalar) -> Scalar:
        return self.graph.subtract(other, self)

    def __mul__(self, other: Scalar) -> Scalar:
        return self.graph.multiply(self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Scalar) -> Scalar:
        return self.graph.divide(self, other)

    def __rtruediv__(self, other: Scalar) -> Scalar:
        return self.graph.divide(other, self)

    def __neg__(self) -> Scalar:
        return self.graph.negate(self)


class Graph:
    """Creates and simplifies symbols."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[Any, ...], Symbol] = {}

    def variable(self, name: str) -> Symbol:
        """Return a symbol for an input of the function."""
        return self._node("variable", (), name)

    def add(self, a: Scalar, b: Scalar) -> Scalar:
        """Sum a + b; a difference if one of them is negated."""
        if _is_zero(a):
            return b
        if _is_zero(b):
            return a
        if _is_negated(b):
            return self.subtract(a, b.arguments[0])
        if _is_negated(a):
            return self.subtract(b, a.arguments[0])
        return self._node("+", _ordered(a, b))

    def subtract(self, a: Scalar, b: Scalar) -> Scalar:
        """Difference a - b; b - a is its negative, so the two share one node."""
        if _is_zero(b):
            return a
        if _is_zero(a):
            return self.negate(b)
        if a is b:
            return 0.0
        if _is_negated(b):
            return self.add(a, b.arguments[0])
        if _is_negated(a):
            return self.negate(self.add(a.arguments[0], b))
        if ("-", _key(b), _key(a), "") in self._nodes:
            return self.negate(self._node("-", (b, a)))
        return self._node("-", (a, b))

    def negate(self, a: Scalar) -> Scalar:
        """-a."""
        if not isinstance(a, Symbol):
            return -a
        if _is_negated(a):
            return a.arguments[0]
        return self._node("negate", (a,))

    def multiply(self, a: Scalar, b: Scalar) -> Scalar:
        """Product a b: signs are pulled out, constants are multiplied together."""
        a, b = _ordered(a, b)  # a constant comes first
        if _is_negated(b):
            return self.negate(self.multiply(a, b.arguments[0]))
        if _is_negated(a):
            return self.negate(self.multiply(a.arguments[0], b))
        if not isinstance(a, Symbol):
            return self._scaled(float(a), b)
        return self._node("*", (a, b))

    def _scaled(self, factor: float, b: Symbol) -> Scalar:
        if factor == 0.0:
            return 0.0
        if factor < 0.0:
            return self.negate(self._scaled(-factor, b))
        if factor == 1.0:
            return b
        if b.operation == "*" and not isinstance(b.arguments[0], Symbol):
            return self._scaled(factor * b.arguments[0], b.arguments[1])
        return self._node("*", (factor, b))

    def divide(self, a: Scalar, b: Scalar) -> Scalar:
        """Quotient a / b."""
        if _is_zero(a):
            return 0.0
        if not isinstance(b, Symbol):
            return self.multiply(a, 1.0 / b)
        return self._node("/", (a, b))

    def trigonometric(self, function: str, x: Symbol) -> Scalar:
        """Sine or cosine; a constant part that is a multiple of pi/2 is taken out of the angle."""
        if _is_negated(x):
            inner = self.trigonometric(function, x.arguments[0])
            return -inner if function == "sin" else inner
        rest, constant = _without_constant(x)
        quarters = quarter_turns(constant)
        if quarters is None or constant == 0.0 or not isinstance(rest, Symbol):
            return self._node(function, (x,))
        turned = quarters % 4
        if turned % 2:
            function, turned = ("cos", turned - 1) if function == "sin" else ("sin", turned + 1)
        value = self.trigonometric(function, rest)
        return -value if turned % 4 == 2 else value

    def call(self, function: str, arguments: tuple[Scalar, ...]) -> Symbol:
        """Return a call of a library function; it has no derivative here."""
        return self._node(function, arguments)

    def _node(self, operation: str, arguments: tuple[Any, ...], name: str = "") -> Symbol:
        key = (operation, *map(_key, arguments), name)
        node = self._nodes.get(key)
        if node is None:
            node = self._nodes[key] = Symbol(self, len(self._nodes), operation, arguments, name)
        return node


def _key(a: Scalar) -> Any:
    return a.number if isinstance(a, Symbol) else ("constant", float(a))


def _is_zero(a: Scalar) -> bool:
    return not isinstance(a, Symbol) and a == 0.0


def _is_negated(a: Scalar) -> bool:
    return isinstance(a, Symbol) and a.operation == "negate"


def _ordered(a: Scalar, b: Scalar) -> tuple[Scalar, Scalar]:
    """Return two operands in canonical order for commutative nodes: constants first, then by creation."""
    rank_a, rank_b = (x.number if isinstance(x, Symbol) else -1 for x in (a, b))
    return (a, b) if rank_a <= rank_b else (b, a)


def _without_constant(x: Symbol) -> tuple[Scalar, float]:
    if x.operation == "+" and not isinstance(x.arguments[0], Symbol):
        return x.arguments[1], x.arguments[0]
    if x.operation == "-" and not isinstance(x.arguments[1], Symbol):
        return x.arguments[0], -x.arguments[1]
    return x, 0.0


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
    exec(compile(source, f"<traced {name}>", "exec"), scope)  # the source is generated from numbers and names only
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
        f"    {', '.join(s.name for s in group)}, = a{i}" for i, group in enumerate(inputs) if not isinstance(group, Symbol)
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
