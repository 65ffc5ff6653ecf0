"""Tracing keeps the value of a function, folds what is constant, and touches no calibrated number."""

import math
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from control.kinematics import tracing
from control.kinematics.tracing import Graph, Symbol, compile_function, cos, derivative, function_source, sin


def _traced(function: Callable[..., Any], names: str = "xyz") -> tuple[list[Symbol], Any]:
    graph = Graph()
    symbols = [graph.variable(name) for name in names]
    return symbols, function(*symbols)


def _source(function: Callable[..., Any], names: str = "xyz") -> str:
    symbols, result = _traced(function, names)
    return function_source("f", symbols, result).splitlines()[-1].strip()


@pytest.mark.parametrize(
    ("function", "source"),
    [
        (lambda x, y, z: x * 0.0 + y, "return y"),
        (lambda x, y, z: 0.0 + x * 1.0 - 0.0, "return x"),
        (lambda x, y, z: x * -1.0 + y, "return (y - x)"),
        (lambda x, y, z: -(0.0 - x), "return x"),
        (lambda x, y, z: x - x, "return 0.0"),
        (lambda x, y, z: (-x) * (-y), "return (x * y)"),
        (lambda x, y, z: 2.0 * (3.0 * x), "return (6.0 * x)"),
        (lambda x, y, z: x * y - y * x, "return 0.0"),
        (lambda x, y, z: sin(-x) + cos(-x), "return (cos(x) - sin(x))"),
        (lambda x, y, z: sin(x + math.pi / 2), "return cos(x)"),
        (lambda x, y, z: cos(math.pi / 2 + x), "return (-sin(x))"),
        (lambda x, y, z: sin(x - math.pi), "return (-sin(x))"),
        (lambda x, y, z: cos(x - math.pi / 2), "return sin(x)"),
        (lambda x, y, z: cos(math.pi / 2) * x + sin(math.pi / 2) * y, "return y"),
        (lambda x, y, z: x / 2.0, "return (0.5 * x)"),
        (lambda x, y, z: 0.0 / x, "return 0.0"),
    ],
)
def test_dead_arithmetic_is_gone(function: Callable[..., Any], source: str) -> None:
    assert _source(function) == source


def test_a_calibrated_angle_is_not_taken_for_a_right_one() -> None:
    for off in (1e-14, 1e-9, -1e-12):
        assert "1.57" in _source(lambda x, y, z, off=off: sin(x + (math.pi / 2 + off)))
        assert cos(math.pi / 2 + off) == math.cos(math.pi / 2 + off) != 0.0


def test_equal_expressions_are_computed_once() -> None:
    symbols, result = _traced(lambda x, y, z: ((x + y) * z, (y + x) * (z * (x + y)), sin(x) * sin(x)))
    source = function_source("f", symbols, result)
    assert source.count("+") == 1
    assert source.count("sin(x)") == 1


def test_a_difference_and_its_negative_share_their_work() -> None:
    symbols, result = _traced(lambda x, y, z: (x * y - z, z - x * y))
    assert function_source("f", symbols, result).count("*") == 1


_GRAMMAR = ["+", "-", "*", "sin", "cos", "negate", "constant", "variable"]


def _random_expression(source: random.Random, values: list[Any], depth: int) -> Any:
    kind = source.choice(_GRAMMAR if depth else _GRAMMAR[-2:])
    if kind == "constant":
        return source.choice([0.0, 1.0, -1.0, math.pi / 2, -math.pi / 2, math.pi, 0.3, -2.5])
    if kind == "variable":
        return source.choice(values)
    a = _random_expression(source, values, depth - 1)
    if kind in ("sin", "cos"):
        return sin(a) if kind == "sin" else cos(a)
    if kind == "negate":
        return -a
    b = _random_expression(source, values, depth - 1)
    return a + b if kind == "+" else a - b if kind == "-" else a * b


@given(st.integers(0, 10**9))
def test_any_function_traced_has_the_values_and_slopes_of_the_function(seed: int) -> None:
    def function(*values: Any) -> Any:
        return _random_expression(random.Random(seed), list(values), 5)

    symbols, result = _traced(function)
    point = [0.37, -1.21, 0.83]
    traced = compile_function("f", symbols, (result, derivative([result], symbols[0])[0]))
    value, slope = traced(*point)
    assert value == pytest.approx(function(*point), rel=1e-9, abs=1e-9)
    h = 1e-6
    ahead, behind = (function(point[0] + d, *point[1:]) for d in (h, -h))
    assert slope == pytest.approx((ahead - behind) / (2 * h), rel=1e-4, abs=1e-4)


def test_the_generic_functions_also_take_arrays_and_floats() -> None:
    angles = np.array([0.1, 0.2])
    assert np.array_equal(sin(angles), np.sin(angles))
    assert tracing.sqrt(4.0) == 2.0
    assert np.array_equal(tracing.atan2(angles, 1.0), np.arctan2(angles, 1.0))
    assert tracing.acos(1.0) == 0.0


def test_inputs_may_come_as_sequences_and_outputs_keep_their_shape() -> None:
    graph = Graph()
    a, b, c = (graph.variable(name) for name in "abc")
    function = compile_function("f", [[a, b], c], ((a, b), (c * 2.0,), 1.5))
    assert function((1.0, 2.0), 3.0) == ((1.0, 2.0), (6.0,), 1.5)
    batch = compile_function("f", [a, b], (sin(a) * b,), np)
    assert batch(np.zeros(3), np.ones(3))[0].shape == (3,)


def test_what_has_no_derivative_says_so() -> None:
    x = Graph().variable("x")
    with pytest.raises(NotImplementedError, match="acos"):
        derivative([tracing.acos(x)], x)
    assert derivative([x / 2.0, 3.0, 1.0 / x], x)[:2] == [0.5, 0.0]
