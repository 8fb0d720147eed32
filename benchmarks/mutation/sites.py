"""Finds the places of a module where one small mistake can be made.

A mistake is one of: another comparison, another operator, another number, flag or
name, ``and`` for ``or``, a condition turned round, a statement left out, another exception raised
or caught, nothing returned. Type hints, decorators, docstrings and sentences are left as they are:
a sentence that reads otherwise is no fault of a recorder.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, MutableSequence
from dataclasses import dataclass
from typing import Any

# Python raises it for nothing that happens in a recorder, and nobody catches it.
STRANGE = 'BufferError'
_BOUNDARY = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_OPPOSITE = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
# Not `/`, which joins paths here: with any other operator the first call is an error.
_OPERATOR = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}  # fmt: skip
_REMOVED = (ast.AugAssign, ast.Raise, ast.Continue, ast.Break, ast.Delete)


@dataclass(frozen=True)
class Site:
    """One place and one mistake: ``swap`` makes it in the tree, and then unmakes it."""

    kind: str
    line: int
    function: str
    statement: ast.AST
    swap: Callable[[], None]


@dataclass(frozen=True)
class Mutant:
    """A mistake as it is written down; ``nth`` tells equal ones of a function apart."""

    module: str
    index: int
    kind: str
    line: int
    function: str
    before: str
    after: str
    nth: int


class _Finder(ast.NodeVisitor):
    """Walks over a module's statements and gathers the sites."""

    def __init__(self) -> None:
        self.sites: list[Site] = []
        self._names: list[str] = []
        self._statement: ast.AST = ast.Pass()

    def _add(self, kind: str, node: ast.AST, swap: Callable[[], None]) -> None:
        line = getattr(node, 'lineno', getattr(self._statement, 'lineno', 0))
        function = '.'.join(self._names)
        self.sites.append(Site(kind, line, function, self._statement, swap))

    def _put(self, kind: str, node: ast.AST, name: str, value: object) -> None:
        other = [value]

        def swap() -> None:
            mine = getattr(node, name)
            setattr(node, name, other[0])
            other[0] = mine

        self._add(kind, node, swap)

    def _put_item(
        self, kind: str, node: ast.AST, items: MutableSequence[Any], k: int, value: object
    ) -> None:
        other = [value]

        def swap() -> None:
            items[k], other[0] = other[0], items[k]

        self._add(kind, node, swap)

    # --- statements -----------------------------------------------------------------------

    def generic_visit(self, node: ast.AST) -> None:
        for name, value in ast.iter_fields(node):
            if isinstance(value, list) and value and isinstance(value[0], ast.stmt):
                self._body(node, name, value)
            elif isinstance(value, ast.AST):
                self.visit(value)
            elif isinstance(value, list):
                for item in value:
                    if isinstance(item, ast.AST):
                        self.visit(item)

    def _body(self, node: ast.AST, name: str, body: list[ast.stmt]) -> None:
        before = self._statement
        for k, statement in enumerate(body):
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                continue
            self._statement = statement
            if _may_go(statement):
                self._put_item('statement', statement, body, k, ast.Pass())
            self.visit(statement)
        self._statement = before

    def _named(self, node: ast.FunctionDef | ast.ClassDef) -> None:
        self._names.append(node.name)
        if isinstance(node, ast.FunctionDef):
            for value in [*node.args.defaults, *node.args.kw_defaults]:
                if value is not None:
                    self.visit(value)
        self._body(node, 'body', node.body)
        self._names.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._named(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._named(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        self._condition(node)

    def visit_While(self, node: ast.While) -> None:
        self._condition(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._condition(node)

    def _condition(self, node: ast.If | ast.While | ast.IfExp) -> None:
        if not isinstance(node.test, ast.Compare | ast.Constant):
            turned = ast.UnaryOp(ast.Not(), node.test)
            if isinstance(node.test, ast.UnaryOp) and isinstance(node.test.op, ast.Not):
                self._put('condition', node, 'test', node.test.operand)
            else:
                self._put('condition', node, 'test', turned)
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not isinstance(node.value, ast.Constant):
            self._put('return', node, 'value', ast.Constant(None))
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        if isinstance(node.exc, ast.Call):
            self._put('exception', node, 'exc', ast.Call(ast.Name(STRANGE), node.exc.args, []))
        self.generic_visit(node)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        before, self._statement = self._statement, node
        if isinstance(node.type, ast.Tuple):
            for k in range(len(node.type.elts)):
                rest = [*node.type.elts[:k], *node.type.elts[k + 1 :]]
                self._put('exception', node, 'type', ast.Tuple(rest, ast.Load()))
        elif node.type is not None:
            self._put('exception', node, 'type', ast.Name(STRANGE))
        self._body(node, 'body', node.body)
        self._statement = before

    # --- expressions ----------------------------------------------------------------------

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ''
        if name == 'suppress' or (isinstance(node.func, ast.Name) and node.func.id == 'suppress'):
            for k in range(len(node.args)):
                self._put_item('exception', node, node.args, k, ast.Name(STRANGE))
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for k, operator in enumerate(node.ops):
            for others in (_BOUNDARY, _OPPOSITE):
                other = others.get(type(operator))
                if other is not None:
                    self._put_item('comparison', node, node.ops, k, other())
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._operator(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._operator(node)

    def _operator(self, node: ast.BinOp | ast.AugAssign) -> None:
        other = _OPERATOR.get(type(node.op))
        if other is not None:
            self._put('arithmetic', node, 'op', other())
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._put('boolean', node, 'op', ast.And() if isinstance(node.op, ast.Or) else ast.Or())
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant):
            self._put('constant', node, 'op', ast.UAdd())
            return
        self.generic_visit(node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                self.visit(part.value)

    def visit_Constant(self, node: ast.Constant) -> None:
        other = _other_constant(node.value)
        if other is not None:
            self._put('constant', node, 'value', other)


def _may_go(statement: ast.stmt) -> bool:
    """Tell whether something can be left out without the rest being nonsense."""
    if isinstance(statement, ast.Assign):
        # Without a local name the next line is an error that any test finds.
        return not any(isinstance(target, ast.Name) for target in statement.targets)
    if isinstance(statement, ast.Return):
        return statement.value is None
    if isinstance(statement, ast.Expr):
        return isinstance(statement.value, ast.Call)
    return isinstance(statement, _REMOVED)


def _other_constant(value: object) -> object:
    """Return another constant of that type; None where there is no fair one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 2.0 * value if value else 1.0
    if isinstance(value, str | bytes) and value:
        blank = ' ' if isinstance(value, str) else b' '
        if blank in value.strip():  # type: ignore[operator]
            return None
        return f'XX{value}' if isinstance(value, str) else b'XX' + value
    return None


def _sites(tree: ast.Module) -> list[Site]:
    finder = _Finder()
    finder.visit(tree)
    return finder.sites


def _text(statement: ast.AST) -> str:
    return ast.unparse(ast.fix_missing_locations(statement))


def _header(text: str) -> str:
    """Return the first line of a statement, without its decorators."""
    return next((line.strip() for line in text.splitlines() if not line.startswith('@')), '')


def mutated(source: str, index: int) -> str:
    """Return a module's text with the mistake of that number in it."""
    tree = ast.parse(source)
    _sites(tree)[index].swap()
    return _text(tree) + '\n'


def mutants(module: str, source: str) -> Iterator[Mutant]:
    """Give every mutant of a module, each different one once."""
    known: set[tuple[int, str]] = set()
    named: dict[tuple[str, str, str], int] = {}
    for index, site in enumerate(_sites(ast.parse(source))):
        right = _text(site.statement)
        if site.kind == 'statement':
            wrong = 'pass'
        else:
            site.swap()
            wrong = _text(site.statement)
            site.swap()
        if wrong == right or (id(site.statement), wrong) in known:
            continue
        known.add((id(site.statement), wrong))
        before, after = _header(right), _header(wrong)
        key = (site.function, before, after)
        nth = named[key] = named.get(key, -1) + 1
        yield Mutant(module, index, site.kind, site.line, site.function, before, after, nth)
