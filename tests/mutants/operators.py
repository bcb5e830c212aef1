"""What a deliberate fault is: one comparison, sum, number, condition, return or statement that is another one."""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType
from typing import Final, NamedTuple

Variants = Callable[[ast.AST], Iterator[ast.AST]]

COMPARISONS: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
ARITHMETIC: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
NAMES: Final = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}


def _compare(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.Compare)
    for k, operator in enumerate(node.ops):
        for other in COMPARISONS[type(operator)]:
            yield ast.Compare(node.left, [*node.ops[:k], other(), *node.ops[k + 1 :]], node.comparators)


def _arithmetic(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.BinOp)
    if type(node.op) in ARITHMETIC:
        yield ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)


def _augmented(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.AugAssign)
    yield ast.Pass()
    if type(node.op) in ARITHMETIC:
        yield ast.AugAssign(node.target, ARITHMETIC[type(node.op)](), node.value)


def _boolean(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.BoolOp)
    yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)


def _unary(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.UnaryOp)
    yield node.operand


def _constant(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.Constant)
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int):
        yield ast.Constant(value + 1)
    elif isinstance(value, float):
        yield ast.Constant(1.5 * value if value else 1.0)


def _condition(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.If | ast.IfExp | ast.While)
    found = copy.copy(node)
    found.test = ast.copy_location(ast.UnaryOp(ast.Not(), node.test), node.test)
    yield found


def _return(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.Return)
    if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield ast.Return(ast.copy_location(ast.Constant(None), node))


def _dropped(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.Expr | ast.Raise | ast.Assign)
    documented = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    named = isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) for t in node.targets)
    if not documented and not named:  # without its name a function cannot run at all
        yield ast.Pass()


def _called(node: ast.AST) -> Iterator[ast.AST]:
    assert isinstance(node, ast.Call)
    name = node.func
    if isinstance(name, ast.Name) and name.id in NAMES:
        yield ast.Call(ast.copy_location(ast.Name(NAMES[name.id], ast.Load()), name), node.args, node.keywords)
    elif isinstance(name, ast.Attribute) and name.attr in NAMES:
        other = ast.copy_location(ast.Attribute(name.value, NAMES[name.attr], ast.Load()), name)
        yield ast.Call(other, node.args, node.keywords)


OPERATORS: Final[dict[type[ast.AST], Variants]] = {
    ast.Compare: _compare,
    ast.BinOp: _arithmetic,
    ast.AugAssign: _augmented,
    ast.BoolOp: _boolean,
    ast.UnaryOp: _unary,
    ast.Constant: _constant,
    ast.If: _condition,
    ast.IfExp: _condition,
    ast.While: _condition,
    ast.Return: _return,
    ast.Expr: _dropped,
    ast.Raise: _dropped,
    ast.Assign: _dropped,
    ast.Call: _called,
    ast.Break: lambda _: iter([ast.Continue()]),
    ast.Continue: lambda _: iter([ast.Break()]),
}


class Mutant(NamedTuple):
    """A fault in a file: the function and line where it is, what stood there, and what stands there now."""

    path: Path
    function: str
    line: int
    before: str
    after: str
    tree: ast.Module

    def __str__(self) -> str:
        """Return where it is and what was changed, in one line."""
        return f"{self.path.name}:{self.line} {self.function}: {self.before} -> {self.after}"

    def code(self) -> CodeType:
        """Return the faulty module, compiled."""
        return compile(self.tree, str(self.path), "exec", dont_inherit=True)


def mutants_of(path: Path) -> list[Mutant]:
    """Return every fault that can be put into a file, in the order of its lines."""
    tree = ast.parse(path.read_text())
    found = []
    for parent, field, place, function in _places(tree, ""):
        old = getattr(parent, field) if place is None else getattr(parent, field)[place]
        for new in OPERATORS[type(old)](old):
            ast.copy_location(new, old)
            before, after = _short(old), _short(new)
            if before == after:
                continue
            _put(parent, field, place, new)
            found.append(Mutant(path, function, old.lineno, before, after, copy.deepcopy(tree)))
            _put(parent, field, place, old)
    return found


def _put(parent: ast.AST, field: str, place: int | None, node: ast.AST) -> None:
    if place is None:
        setattr(parent, field, node)
    else:
        getattr(parent, field)[place] = node


def _short(node: ast.AST) -> str:
    """Return a node as text of one line; of a block its head."""
    return ast.unparse(node).partition("\n")[0][:90]


SILENT: Final = ("annotation", "returns", "decorator_list", "type_comment", "exc", "msg")
"""What is no part of what a program does, or is the text of an error."""


def _places(node: ast.AST, function: str) -> Iterator[tuple[ast.AST, str, int | None, str]]:
    """Yield where nodes stand that an operator can change: the parent, its field, the place in it, the function."""
    for field, value in ast.iter_fields(node):
        if field in SILENT or isinstance(node, ast.JoinedStr):
            continue
        for place, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST):
                continue
            if type(child) in OPERATORS:
                yield node, field, place, function or "module"
            inner = function
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inner = f"{function}.{child.name}".lstrip(".")
                if child.name in ("__repr__", "_repr_html_"):
                    continue
            yield from _places(child, inner)
