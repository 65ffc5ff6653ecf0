"""Small changes of a module's code, one at a time: turned comparisons, other limits, another reaction, a line left out."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

TURNED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OTHER: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.Pow: ast.Mult,
}
CALLED = {"min": "max", "max": "min", "all": "any", "any": "all", "abs": "float"}
MEMBERS = {
    "Reaction": ("CONTROLLED", "HOLD", "BRAKE"),
    "Mode": ("OFF", "BRAKED", "HOLDING", "MOVING", "HOMING", "GUIDING", "STOPPING", "FAULT", "JOGGING", "PAUSED"),
    "Event": ("STOP", "BRAKE", "HOME", "HOMED", "MOVE", "STOPPED", "FAULT"),
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: where, the line before and after, and the whole module."""

    line: int
    before: str
    after: str
    source: str

    @property
    def change(self) -> str:
        """As tests/mutants/survivors.toml lists it: without the line, which moves."""
        return f"`{self.before}` to `{self.after}`"

    def __str__(self) -> str:
        return f"{self.line}: {self.change}"


def sites_of(source: str) -> list[tuple[int, int]]:
    """The places of a module that can be changed: the number of a node, and which of its changes."""
    tree = ast.parse(source)
    left_out = _not_mutated(tree)
    return [
        (number, variant)
        for number, node in enumerate(located(tree))
        if id(node) not in left_out
        for variant in range(_variants(node))
    ]


def mutants_of(source: str, sites: Iterable[tuple[int, int]] | None = None) -> Iterator[Mutant]:
    """The mutants of a module at `sites`, or all of them."""
    tree = ast.parse(source)
    unchanged = ast.unparse(tree)
    for number, variant in sites_of(source) if sites is None else sites:
        changed = copy.deepcopy(tree)
        twin = located(changed)[number]
        line, before = twin.lineno, ast.unparse(twin)
        _change(changed, twin, variant)
        after = ast.unparse(ast.fix_missing_locations(changed))
        if after != unchanged:
            now = _short(ast.unparse(twin))
            is_gone = now == _short(before)
            yield Mutant(line, _short(before), "left out" if is_gone else now, after)


def located(tree: ast.AST) -> list[ast.expr | ast.stmt]:
    """The nodes that are counted: expressions and statements."""
    return [node for node in ast.walk(tree) if isinstance(node, ast.expr | ast.stmt)]


def _not_mutated(tree: ast.Module) -> set[int]:
    """Nodes of docstrings, texts, types and imports."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST] = []
        match node:
            case ast.JoinedStr() | ast.Import() | ast.ImportFrom():
                parts = [node]
            case ast.FunctionDef():
                arguments = [*node.args.args, *node.args.kwonlyargs]
                parts = [*node.decorator_list, *(a.annotation for a in arguments if a.annotation)]
                parts += [node.returns] if node.returns else []
            case ast.ClassDef():
                parts = [*node.decorator_list, *node.bases]
            case ast.AnnAssign():
                parts = [node.annotation]
        for part in parts:
            skipped |= {id(inner) for inner in ast.walk(part)}
    return skipped


def _variants(node: ast.AST) -> int:
    match node:
        case ast.Compare(ops=[op]):
            return len(TURNED.get(type(op), ()))
        case ast.BoolOp() | ast.UnaryOp(op=ast.Not() | ast.USub()):
            return 1
        case ast.BinOp(op=op):
            return int(type(op) in OTHER)
        case ast.Constant(value=bool() | int() | float()):
            return 1
        case ast.Attribute(value=ast.Name(id=name)) if name in MEMBERS:
            return 1 if name != "Reaction" else 2
        case ast.Call(func=ast.Name(id=name)):
            return int(name in CALLED)
        case ast.If() | ast.IfExp():
            return 1
        case ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.Continue():
            return 1
        case ast.Assign(targets=[ast.Attribute()]) | ast.Assign(targets=[ast.Subscript()]):
            return 1
    return 0


def _change(tree: ast.Module, node: ast.AST, variant: int) -> None:
    match node:
        case ast.Compare(ops=[op]):
            node.ops = [TURNED[type(op)][variant]()]
        case ast.BoolOp():
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        case ast.UnaryOp(op=ast.Not()):
            _replace(tree, node, node.operand)
        case ast.UnaryOp():
            _replace(tree, node, node.operand)
        case ast.BinOp():
            node.op = OTHER[type(node.op)]()
        case ast.Constant(value=bool() as value):
            node.value = not value
        case ast.Constant(value=int() as value):
            node.value = value + 1
        case ast.Constant(value=float() as value):
            node.value = 2.0 * value if value else 1.0
        case ast.Attribute(value=ast.Name(id=name)):
            others = [member for member in MEMBERS[name] if member != node.attr]
            node.attr = others[variant]
        case ast.Call(func=ast.Name(id=name)):
            node.func = ast.Name(CALLED[name], ast.Load())
        case ast.If() | ast.IfExp():
            node.test = ast.UnaryOp(ast.Not(), node.test)
        case _:
            _replace(tree, node, ast.Pass())


def _replace(tree: ast.Module, old: ast.AST, new: ast.AST) -> None:
    class Replacer(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return new if node is old else super().generic_visit(node)

    Replacer().visit(tree)


def _short(code: str) -> str:
    first = code.splitlines()[0]
    return first if len(first) <= 90 else first[:87] + "..."
