"""Mutants: lines that no test guards.

    python tests/mutants.py [NUMBER] [--seed N] [--rooms NAME …] [--workers N] [--list]

A mutant is the package with one change: a statement or a condition dropped, a comparison turned, an
argument left out, a number doubled. The tests that execute the changed line are run on it, the
fastest file first, until one fails; a mutant that none of them notices survives. Whether it changes
a result, a person must say: `x < 1e-9` may be `x < 2e-9`, and a cache may be left out.

The first call finds what every test file executes (the time of the whole suite, kept in
.cache/mutants until a test file changes). Results are appended to out/mutants.jsonl, and a second
call goes on after the last; `--list` prints those that survived.
"""

import argparse
import ast
import copy
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).parent.parent
CACHE, RESULTS = ROOT / ".cache" / "mutants", ROOT / "out" / "mutants.jsonl"
ROOMS = ("leastsquares", "network", "orientation", "reconstruction", "tiepoints", "surface")
TIMES_AS_LONG, LEAST = 4, 60
"""A mutant that takes this many times as long as the package, and so many seconds, is noticed."""
TURNED = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("number", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=ROOMS, metavar="NAME")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    lines = RESULTS.read_text(encoding="utf-8").splitlines() if RESULTS.exists() else []
    known = [json.loads(line) for line in lines]
    if given.list:
        for result in known:
            if not result["noticed"]:
                print(f"{result['place']}: {result['change']}", *result["after"][:4], sep="\n    ")
        return 0
    executed = what_tests_execute(given.workers)
    sites = [site for room in given.rooms for site in sites_of(room)]
    random.Random(given.seed).shuffle(sites)
    done = {result["place"] for result in known}
    chosen = [site for site in sites[: given.number] if site.place not in done]
    RESULTS.parent.mkdir(exist_ok=True)
    copies: Queue = Queue()
    for worker in range(given.workers):
        copies.put(worker)

    def examine(site) -> dict:
        worker = copies.get()
        try:
            return site.examine(CACHE / f"copy{worker}", executed)
        finally:
            copies.put(worker)

    with ThreadPoolExecutor(given.workers) as pool, RESULTS.open("a", encoding="utf-8") as file:
        for result in pool.map(examine, chosen):
            known.append(result)
            print(json.dumps(result, ensure_ascii=False), file=file, flush=True)
            verdict = f"noticed by {result['noticed']}" if result["noticed"] else "SURVIVED"
            print(f"{result['place']}: {result['change']}: {verdict}", flush=True)
    survived = sum(not result["noticed"] for result in known)
    print(f"{survived} of {len(known)} survived ({100 * survived / max(len(known), 1):.1f} %)")
    return 0


# ------------------------------------------------------------------------------- the changes


class Site:
    """One change of one file: `number` is that of its node in `ast.walk`; `inside`: of a function,
    where the tests that execute its line are known. Others are executed when they are imported."""

    def __init__(self, path: Path, number: int, kind: str, node, detail: int, inside: bool):
        self.path, self.number, self.kind, self.detail = path, number, kind, detail
        self.inside = inside
        self.line, self.end = node.lineno, node.end_lineno
        self.place = f"{path.relative_to(ROOT)}:{node.lineno}:{node.col_offset} {kind} {detail}"

    def mutated(self, tree: ast.Module) -> tuple[ast.Module, str, str]:
        """The changed module, and the changed piece before and after."""
        tree = copy.deepcopy(tree)
        nodes = list(ast.walk(tree))
        node = nodes[self.number]
        before = ast.unparse(node)
        if self.kind == "drop":
            self._replace(tree, node, ast.Pass())
            return tree, before, "pass"
        if self.kind == "turn":
            node.ops[self.detail] = TURNED[type(node.ops[self.detail])]()
        elif self.kind == "condition":
            del node.values[self.detail]
        elif self.kind == "factor":
            node.right, node.op = node.left, ast.BitOr()  # x & y becomes x | x
        elif self.kind == "argument":
            del node.keywords[self.detail]
        else:
            node.value = 2 * node.value
        return tree, before, ast.unparse(node)

    @staticmethod
    def _replace(tree, old, new) -> None:
        for parent in ast.walk(tree):
            for field in ("body", "orelse", "finalbody"):
                block = getattr(parent, field, None)
                if isinstance(block, list) and old in block:
                    block[block.index(old)] = ast.copy_location(new, old)

    def examine(self, folder: Path, executed: dict) -> dict:
        """Run the tests that execute the line on a copy of the package with the change."""
        source = self.path.read_text(encoding="utf-8")
        tree, before, after = self.mutated(ast.parse(source))
        result = {"place": self.place, "change": f"{before[:120]} → {after[:120]}", "noticed": ""}
        shutil.rmtree(folder, ignore_errors=True)
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "jaxbundle", folder / "jaxbundle", ignore=ignored)
        target = folder / self.path.relative_to(ROOT)
        target.write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
        name = str(self.path.relative_to(ROOT))
        lines = set(range(self.line, self.end + 1)) if self.inside else _lines_of_functions(source)
        tests = [
            (found["seconds"], test) for test, found in executed.items()
            if lines & set(found["lines"].get(name, ()))
        ]  # fmt: skip
        result["after"] = source.splitlines()[self.line - 1 : self.end]
        result["tests"] = [test for _, test in sorted(tests)]
        for seconds, test in sorted(tests):
            if run_tests(test, folder, max(LEAST, TIMES_AS_LONG * seconds)):
                return result | {"noticed": test}
        return result


def sites_of(room: str) -> list[Site]:
    """All changes of a room, in the order of its files."""
    found = []
    for path in sorted((ROOT / "jaxbundle" / room).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = _lines_of_functions(path.read_text(encoding="utf-8"))
        for number, node in enumerate(ast.walk(tree)):
            inside = getattr(node, "lineno", 0) in functions
            found += [Site(path, number, kind, node, k, inside) for kind, k in kinds_of(node)]
    return found


def _lines_of_functions(source: str) -> set[int]:
    """The lines of the bodies of all functions of a module."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    return {k for n in functions for k in range(n.body[0].lineno, n.end_lineno + 1)}


def kinds_of(node: ast.AST) -> list[tuple[str, int]]:
    """The changes of a node that leave a program which may run."""
    match node:
        case ast.AugAssign() | ast.Expr(value=ast.Call()):
            return [("drop", 0)]
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return [("drop", 0)]
        case ast.If(orelse=[]):
            return [("drop", 0)]
        case ast.Compare():
            return [("turn", k) for k in range(len(node.ops))]
        case ast.BoolOp():
            return [("condition", k) for k in range(len(node.values))]
        case ast.BinOp(op=ast.BitAnd()):
            return [("factor", 0)]
        case ast.Call():
            return [("argument", k) for k, word in enumerate(node.keywords) if word.arg]
        case ast.Constant(value=float()):
            return [("double", 0)]
        case ast.Constant(value=int()) if node.value > 2 and node.value is not True:
            return [("double", 0)]
    return []


# ------------------------------------------------------------------------------- the tests


def run_tests(test: str, folder: Path, seconds: float, *how: str) -> bool:
    """Whether the tests of a file fail, with the package of a folder."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *how, "-m", "pytest", "-x", "-q", "-m", "not further", test]
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, timeout=seconds,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return True
    return done.returncode not in (0, 5)  # 5: no test was left to run


def what_tests_execute(workers: int) -> dict:
    """Of every test file the seconds it takes and the lines of the package that it executes."""
    tests = [str(p.relative_to(ROOT)) for p in sorted((ROOT / "tests").rglob("test_*.py"))]
    CACHE.mkdir(parents=True, exist_ok=True)

    def examine(test: str) -> dict:
        digest = hashlib.sha256((ROOT / test).read_bytes()).hexdigest()[:16]
        kept = CACHE / f"{test.replace('/', '.')}.{digest}.json"
        if not kept.exists():
            data = kept.with_suffix(".coverage")
            begin = time.monotonic()
            how = ("-m", "coverage", "run", f"--data-file={data}", f"--include={ROOT}/jaxbundle/*")
            run_tests(test, ROOT, 3600, *how)
            seconds = time.monotonic() - begin
            kept.write_text(json.dumps({"seconds": seconds, "lines": read_coverage(data)}))
            data.unlink(missing_ok=True)
            print(f"{test}: {seconds:.0f} s", flush=True)
        return json.loads(kept.read_text(encoding="utf-8"))

    with ThreadPoolExecutor(workers) as pool:
        return dict(zip(tests, pool.map(examine, tests)))


def read_coverage(path: Path) -> dict[str, list[int]]:
    """The executed lines by file; none where nothing was executed."""
    from coverage import CoverageData

    data = CoverageData(str(path))
    data.read()
    name = lambda file: str(Path(file).relative_to(ROOT))
    return {name(file): sorted(data.lines(file) or ()) for file in data.measured_files()}


if __name__ == "__main__":
    sys.exit(main())
