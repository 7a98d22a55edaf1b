"""Nothing follows from the order of a set or of a folder, which differ from one process or disk to the next.

A set has another order with each PYTHONHASHSEED. Where the package goes through one, or through the files of a folder,
the order has to be made (`sorted`), or not to matter (`any`, `len`, another set), or the place is listed here.
"""

import ast
from pathlib import Path

import pytest

import unmix_plugin

PACKAGE = Path(unmix_plugin.__file__).parent
ORDER_DOES_NOT_MATTER = {
    "set",
    "frozenset",
    "len",
    "any",
    "all",
    "sum",
    "Counter",
    "sorted",
    "min",
    "max",
    "isdisjoint",
}
MAKES_A_SET = {"union", "intersection", "difference", "symmetric_difference"}
LISTS_A_FOLDER = {"glob", "rglob", "iterdir", "listdir", "scandir"}
TAKES_THE_ORDER = {
    "list",
    "tuple",
    "next",
    "iter",
    "join",
    "enumerate",
    "zip",
    "map",
    "filter",
    "name_some",
    "fromkeys",
}
ALLOWED = {
    "captures/layouts/cubes.py": "ListComp",  # sorted at the end
    "captures/poses/lines.py": "pop",  # of one
    "captures/poses/realitycapture.py": "pop",  # of one
    "commands/demo_scene.py": "list",  # whether there are any
    "commands/image.py": "Call",  # each is removed
    "commands/process_inspect.py": "sorted",  # of texts of different numbers
    "engine/runs/checkpoints.py": "For",  # each is removed
    "engine/runs/replacing.py": "For List",  # each is removed; whether there is one alone
    "engine/runs/run_folder.py": "ListComp GeneratorExp",  # the greatest is taken; sorted
    "formats/libraries.py": "pop",  # of one
    "products/comparison.py": "Call",  # each is removed
    "scenes/pixel_block.py": "pop",  # of one
    "scenes/pixel_table.py": "DictComp",  # looked up by key
    "scenes/reading/faults.py": "For",  # only a single one counts
    "spectral/library/spectral_tables.py": "pop",  # of one
    "viewer/rendering/captures.py": "next",  # of one
}


class Unordered(ast.NodeVisitor):
    """Places where something without order is gone through."""

    def __init__(self) -> None:
        self.found: list[tuple[int, str]] = []
        self._sets: list[set[str]] = [set()]
        self._parents: list[ast.AST] = []

    def _is_unordered(self, node: ast.AST) -> bool:
        match node:
            case ast.Set() | ast.SetComp():
                return True
            case ast.Call(func=ast.Name(id="set" | "frozenset")):
                return True
            case ast.Call(func=ast.Attribute(attr=name)):
                return name in MAKES_A_SET | LISTS_A_FOLDER
            case ast.BinOp(op=ast.BitAnd() | ast.BitOr() | ast.Sub() | ast.BitXor(), left=left, right=right):
                sides = (left, right)
                keys = [
                    side
                    for side in sides
                    if isinstance(side, ast.Call) and _called(side) in ("keys", "items")
                ]
                return bool(keys) or any(map(self._is_unordered, sides))
            case ast.Name(id=name):
                return any(name in sets for sets in self._sets)
            case ast.IfExp(body=body, orelse=orelse):
                return self._is_unordered(body) or self._is_unordered(orelse)
        return False

    def generic_visit(self, node: ast.AST) -> None:
        self._parents.append(node)
        super().generic_visit(node)
        self._parents.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        names = {
            one.arg
            for one in (*node.args.args, *node.args.kwonlyargs)
            if one.annotation and ast.unparse(one.annotation).startswith(("set[", "frozenset["))
        }
        self._sets.append(names)
        for one in ast.walk(node):
            if (
                isinstance(one, ast.Assign)
                and isinstance(one.targets[0], ast.Name)
                and self._is_unordered(one.value)
            ):
                names.add(one.targets[0].id)
        self.generic_visit(node)
        self._sets.pop()

    def visit_For(self, node: ast.For) -> None:
        self._note(node, node.iter)

    def visit_ListComp(self, node: ast.ListComp) -> None:
        self._note_parts(node)

    def visit_GeneratorExp(self, node: ast.GeneratorExp) -> None:
        self._note_parts(node)

    def visit_DictComp(self, node: ast.DictComp) -> None:
        self._note_parts(node)

    def visit_Starred(self, node: ast.Starred) -> None:
        parent = self._parents[-1]
        self._note(node, *(() if isinstance(parent, ast.Set) else (node.value,)), kind=type(parent).__name__)

    def visit_Call(self, node: ast.Call) -> None:
        name = _called(node)
        has_key = name in ("sorted", "min", "max") and any(one.arg == "key" for one in node.keywords)
        keyed = [one for one in node.args if has_key and not isinstance(one, ast.Call)]
        taken = node.args if name in TAKES_THE_ORDER else keyed
        if name == "pop" and isinstance(node.func, ast.Attribute):
            taken = [node.func.value]
        self._note(node, *taken, kind=name)

    def _note_parts(self, node: ast.ListComp | ast.GeneratorExp | ast.DictComp) -> None:
        parent = self._parents[-1]
        is_safe = isinstance(parent, ast.Call) and _called(parent) in ORDER_DOES_NOT_MATTER
        self._note(node, *(() if is_safe else (part.iter for part in node.generators)))

    def _note(self, node: ast.AST, *taken: ast.AST, kind: str = "") -> None:
        if any(map(self._is_unordered, taken)):
            self.found.append((getattr(node, "lineno", 0), kind or type(node).__name__))
        self.generic_visit(node)


def _called(node: ast.Call) -> str:
    match node.func:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return ""


def test_nothing_goes_through_a_set_or_a_folder_whose_order_could_decide():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        visitor, name = Unordered(), path.relative_to(PACKAGE).as_posix()
        visitor.visit(ast.parse(path.read_text(encoding="utf-8")))
        wrong += [
            f"{name}:{at} {kind}" for at, kind in visitor.found if kind not in ALLOWED.get(name, "").split()
        ]
    assert wrong == [], wrong


@pytest.mark.parametrize(
    "text",
    [
        "[x for x in {1, 2}]",
        "for x in set(a) & set(b): print(x)",
        "next(iter({*a}))",
        "sorted({x for x in a}, key=f)",
        "def f(a: set[str]):\n    return [*a]",
        "def f():\n    names = set(a)\n    return list(names)",
        "list(folder.glob('*'))",
        "a.pop() if (b := {1}) else {1}.pop()",
        "{key: 1 for key in a.keys() - b}",
    ],
)
def test_what_has_no_order_is_found(text):
    visitor = Unordered()
    visitor.visit(ast.parse(text))
    assert visitor.found
