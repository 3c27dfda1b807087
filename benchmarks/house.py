"""The code of the package in figures: how much of it explains itself, and how much there is.

    python benchmarks/house.py [FOLDER] [--list WHAT]

FOLDER: a package, by default jaxbundle. `--list` names the places of one row.

    comment lines            a `#` that is not a directive (fmt, noqa, type, pragma), of all lines
                             with code or comment, docstrings left out
    numeric constants        names in capitals of a module that are a number, or only numbers
    used once                private functions of a module that one place of it uses
    fmt: skip                lines that the formatter leaves alone
    not annotated            parameters, other than self, cls and those of a lambda
    names twice              class names that stand in more than one place
    long                     functions of more than 60 lines
    statements, functions    of the syntax tree; docstrings are statements, lambdas functions
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

DIRECTIVE = re.compile(r"#\s*(fmt|noqa|type|pragma|ruff|pyright)\b")
LONGEST = 60
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    here = Path(__file__).parent.parent / "jaxbundle"
    parser.add_argument("folder", nargs="?", type=Path, default=here)
    parser.add_argument("--list", metavar="WHAT")
    given = parser.parse_args()
    places: dict[str, list[str]] = {}
    classes: dict[str, list[str]] = {}
    lines = Counter()
    for path in sorted(given.folder.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        name = str(path.relative_to(given.folder))
        tree = ast.parse(source)
        count_lines(source, tree, lines, name, places)
        count_tree(tree, lines, name, places, classes)
    for name, found in classes.items():
        if len(found) > 1:
            places.setdefault("names twice", []).append(f"{name}: {', '.join(found)}")
    if given.list:
        print(*places.get(given.list, ()), sep="\n")
        return 0
    thousand = lines["code"] / 1000
    once, private = len(places.get("used once", ())), max(lines["private"], 1)
    count = lambda what: len(places.get(what, ()))
    for label, figure in {
        "comment lines": f"{100 * lines['comment'] / (lines['code'] + lines['comment']):.1f} %",
        "numeric constants": f"{count('numeric constants')}, "
        f"{count('numeric constants') / thousand:.1f} per 1000 lines",
        "used once": f"{100 * once / private:.0f} % of {private} private functions",
        "fmt: skip": count("fmt: skip"),
        "not annotated": f"{count('not annotated')} of {lines['parameters']}",
        "names twice": count("names twice"),
        "long": count("long"),
        "statements": lines["statements"],
        "functions": lines["functions"],
        "lines of code": lines["code"],
    }.items():
        print(f"{label:18} {figure}")
    return 0


def count_lines(source: str, tree: ast.Module, lines: Counter, name: str, places) -> None:
    """Lines with code, with a comment, and those kept from the formatter."""
    documented = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for line in range(node.lineno, node.end_lineno + 1)
    }
    code, commented = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if "fmt: skip" in token.string:
                places.setdefault("fmt: skip", []).append(f"{name}:{token.start[0]}")
            if not DIRECTIVE.match(token.string):
                commented.add(token.start[0])
        elif token.type not in (
            tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
        ):  # fmt: skip
            code.update(range(token.start[0], token.end[0] + 1))
    lines["code"] += len(code - documented)
    lines["comment"] += len(commented)


def count_tree(tree: ast.Module, lines: Counter, name: str, places, classes) -> None:
    """What the syntax tree tells."""
    used = Counter(
        node.id if isinstance(node, ast.Name) else node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
        or isinstance(node, ast.Attribute)
    )  # fmt: skip
    for node in tree.body:
        for target, value in _constants(node):
            if _is_numeric(value):
                places.setdefault("numeric constants", []).append(f"{name}:{node.lineno} {target}")
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            classes.setdefault(node.name, []).append(f"{name}:{node.lineno}")
        lines["statements"] += isinstance(node, ast.stmt)
        lines["functions"] += isinstance(node, FUNCTIONS | ast.Lambda)
        if not isinstance(node, FUNCTIONS):
            continue
        place = f"{name}:{node.lineno} {node.name}"
        if node.end_lineno - node.lineno >= LONGEST:
            places.setdefault("long", []).append(place)
        if node.name.startswith("_") and not node.name.startswith("__"):
            lines["private"] += 1
            if used[node.name] == 1:
                places.setdefault("used once", []).append(place)
        a = node.args
        for given in (*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))):
            if given.arg in ("self", "cls"):
                continue
            lines["parameters"] += 1
            if given.annotation is None:
                places.setdefault("not annotated", []).append(f"{place}({given.arg})")


def _constants(node: ast.stmt):
    """Names in capitals that an assignment of a module sets, with their values."""
    if isinstance(node, ast.AnnAssign) and node.value is not None:
        pairs = [(node.target, node.value)]
    elif isinstance(node, ast.Assign):
        pairs = []
        for target in node.targets:
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs += zip(target.elts, node.value.elts)
            else:
                pairs.append((target, node.value))
    else:
        pairs = []
    return [(t.id, v) for t, v in pairs if isinstance(t, ast.Name) and t.id.strip("_").isupper()]


def _is_numeric(value: ast.expr) -> bool:
    """Whether numbers are all it is made of, and there are some."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.Tuple | ast.List):
        return bool(value.elts) and all(map(_is_numeric, value.elts))
    if isinstance(value, ast.UnaryOp):
        return _is_numeric(value.operand)
    if isinstance(value, ast.BinOp):
        return _is_numeric(value.left) and _is_numeric(value.right)
    return False


if __name__ == "__main__":
    sys.exit(main())
