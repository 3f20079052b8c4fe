"""Mutations: all modules with one small fault that a module can be turned into.

A comparison is another, a bound is one further, `and` is `or`, a number is one more, `+` is `-`,
`min` is `max`, a function returns None, a statement is missing. What is for readers only stays:
annotations, assertions, names of types, and texts for people.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import Any, NamedTuple

OPERATORS: dict[type[ast.AST], tuple[type[Any], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.And: (ast.Or,), ast.Or: (ast.And,),
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.BitXor: (ast.BitAnd,),
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum",
         "maximum": "minimum", "left": "right", "right": "left"}  # fmt: skip


class Mutant(NamedTuple):
    """A module with a fault."""

    function: str  # qualified name; empty in no function or class
    was: str  # changed lines, with single spaces
    becomes: str
    line: int
    lines: range  # of the statement, up to its body; empty if it runs at import
    removes: str  # kind of the removed statement, as ``Raise``; else empty
    source: bytes


def changes(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield a node, or one of its parts, and what to put in its place."""
    match node:
        case ast.Compare(left, operators, right):
            for k, operator in enumerate(operators):
                for other in OPERATORS[type(operator)]:
                    changed = [*operators[:k], other(), *operators[k + 1 :]]
                    yield node, ast.Compare(left, changed, right)
        case ast.BoolOp(operator, values):
            yield node, ast.BoolOp(OPERATORS[type(operator)][0](), values)
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            yield node, ast.BinOp(left, OPERATORS[type(operator)][0](), right)
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield node, operand
        case ast.Constant(bool() as value):
            yield node, ast.Constant(not value)
        case ast.Constant(int() | float() as value):
            yield node, ast.Constant(value + 1)
        case ast.Constant(str() as text) if text and " " not in text:  # or else it is for people
            yield node, ast.Constant(NAMES.get(text, ""))
        case ast.Call(ast.Name(name), arguments, keywords) if name in NAMES:
            yield node, ast.Call(ast.Name(NAMES[name]), arguments, keywords)
        case ast.Call(ast.Attribute(value, name), arguments, keywords) if name in NAMES:
            yield node, ast.Call(ast.Attribute(value, NAMES[name]), arguments, keywords)
        case ast.AugAssign(target, operator, value) if type(operator) in OPERATORS:
            yield node, ast.AugAssign(target, OPERATORS[type(operator)][0](), value)
            yield node, ast.Pass()
        case ast.If(test) | ast.While(test) | ast.IfExp(test):
            if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp):
                yield test, ast.UnaryOp(ast.Not(), test)
        case ast.Return(ast.AST() as value):
            if not (isinstance(value, ast.Constant) and value.value is None):
                yield node, ast.Return(ast.Constant(None))
        case ast.Expr(ast.Call() | ast.Await()) | ast.Delete() | ast.Raise():
            yield node, ast.Pass()
        case ast.Break() | ast.Continue() | ast.AnnAssign(ast.Attribute(), value=ast.AST()):
            yield node, ast.Pass()
        case ast.Assign([ast.Attribute() | ast.Subscript() | ast.Tuple([ast.Attribute(), *_]), *_]):
            yield node, ast.Pass()


def says_nothing(node: ast.AST) -> bool:
    """Return whether a part is for readers and type checkers, or of a text for people."""
    match node:
        case ast.Assert() | ast.JoinedStr() | ast.Expr(ast.Constant()):
            return True
        case ast.keyword("kw_only" | "frozen" | "gc" | "eq" | "strict"):
            return True
        case ast.Assign([ast.Name("__slots__" | "__all__")]) | ast.If(ast.Name("TYPE_CHECKING")):
            return True
        case ast.Assign(
            [ast.Name()], ast.Subscript(ast.Name()) | ast.Call(ast.Name("TypeVar" | "ParamSpec"))
        ):
            return node.col_offset == 0  # a name of a type
    return False


def mutants(source: bytes) -> Iterator[Mutant]:
    """Yield all mutants of a module in their order."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def visit(node: Any, scope: str, lines: range, at_import: bool) -> Iterator[Mutant]:
        if says_nothing(node):
            return
        if isinstance(node, ast.stmt) and not at_import:
            body = getattr(node, "body", None)
            stop = body[0].lineno if body else (node.end_lineno or 0) + 1
            lines = range(node.lineno, max(stop, node.lineno + 1))
        part: Any
        for part, other in changes(node):
            begin, end = starts[part.lineno - 1], starts[part.end_lineno]
            head = source[begin : begin + part.col_offset]
            tail = source[starts[part.end_lineno - 1] + part.end_col_offset : end]
            text = ast.unparse(ast.fix_missing_locations(other))
            if isinstance(part, ast.expr) and not isinstance(part, ast.Constant):
                text = f"({text})"
            changed = head + text.encode() + tail
            was, becomes = (" ".join(t.decode().split()) for t in (source[begin:end], changed))
            removes = type(part).__name__ * isinstance(other, ast.Pass)
            whole = source[:begin] + changed + source[end:]
            yield Mutant(scope, was, becomes, part.lineno, lines, removes, whole)
        names = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        for name, value in ast.iter_fields(node):
            if name in {"annotation", "returns"}:
                continue
            inside = names and name == "body"
            inner = f"{scope}.{node.name}".lstrip(".") if inside else scope
            later = at_import and not (inside and not isinstance(node, ast.ClassDef))
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from visit(child, inner, lines, later)

    yield from visit(ast.parse(source), "", range(0), True)
