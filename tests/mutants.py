"""Mutants: lines that no test guards.

    python tests/mutants.py [NUMBER] [--seed N] [--rooms NAME …] [--tests PATH …] [--seconds S]
    python tests/mutants.py --again [--seconds S]     those that survived, once more
    python tests/mutants.py --list

A mutant is the package with one change: a statement or a condition dropped, a comparison turned, an
argument left out, a number doubled. The single tests that execute the changed line run on it, the
fastest first, until one fails; a mutant that none of them notices survives. Whether it changes a
result, a person must say: `x < 1e-9` may be `x < 2e-9`, and a cache may be left out.

The first call finds what every test executes and how long it takes, in about an hour; it is kept in
.cache/mutants until the test file changes. Results are appended to out/mutants.jsonl, and a
second call goes on after the last.
"""

import argparse
import ast
import functools
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent.parent
BEGIN = time.time()
CACHE, RESULTS = ROOT / ".cache" / "mutants", ROOT / "out" / "mutants.jsonl"

# Before JAX is imported. Programs are kept by their content: that of a changed program is another.
os.environ |= {"JAX_COMPILATION_CACHE_DIR": str(CACHE / "jax"), "OPENBLAS_NUM_THREADS": "1"}
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

# What every child process needs and no mutant changes; JAX starts its threads later, in the child.
import equinox, hypothesis, jax, lineax, optimistix, pytest, scipy.optimize  # noqa: E401, E402, F401, I001

ROOMS = ("leastsquares", "network", "orientation", "reconstruction", "tiepoints", "surfaces")
TESTS = (*ROOMS, "adjustment", "statistics", "test_blunders.py", "test_weak_networks.py")
"""Those of other rooms may notice what these do not: messages and reports, above all."""
TIMES_AS_LONG, LEAST = 6, 60
"""A test that takes this many times as long as with the package, and so many seconds, fails."""
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
    parser.add_argument("--tests", nargs="+", default=TESTS, metavar="PATH", help="below tests/")
    parser.add_argument(
        "--seconds", type=float, default=120.0, help="of the tests on a mutant, the fastest first"
    )
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    lines = RESULTS.read_text(encoding="utf-8").splitlines() if RESULTS.exists() else []
    known = {result["mutant"]: result for result in map(json.loads, lines)}
    survivors = [name for name, result in known.items() if not result["noticed"]]
    if options.list:
        for name in survivors:
            print(f"{known[name]['place']} {name}", *known[name]["lines"][:4], sep="\n    ")
        return 0
    sites = [site for room in options.rooms for site in find_sites(room)]
    if options.again:
        chosen = [site for site in sites if site.name in survivors]
    else:
        random.Random(options.seed).shuffle(sites)
        chosen = [site for site in sites[: options.number] if site.name not in known]
    executed = what_tests_execute(options.tests)
    RESULTS.parent.mkdir(exist_ok=True)
    for site in chosen:
        known[site.name] = result = examine(site, executed, options.seconds)
        with RESULTS.open("a", encoding="utf-8") as file:
            print(json.dumps(result, ensure_ascii=False), file=file)
        survived = f"SURVIVED {result['tests']} tests of {result['reaching']}"
        verdict = f"noticed by {result['noticed']}" if result["noticed"] else survived
        print(f"{site.lines[0]}: {site.name}: {verdict} ({result['took']:.0f} s)", flush=True)
    survived = sum(not result["noticed"] for result in known.values())
    print(f"{survived} of {len(known)} survived ({100 * survived / max(len(known), 1):.1f} %)")
    return 0


# ------------------------------------------------------------------------------- the changes


class Site:
    """A change of one node of a file; `lines`: those that a test must execute to notice it. Its
    `name` has no line, so that results remain valid when other lines change."""

    def __init__(self, path: Path, number: int, kind: str, detail: int, node: ast.AST):
        self.path, self.number, self.kind, self.detail = path, number, kind, detail
        self.file = str(path.relative_to(ROOT))
        self.name = f"{self.file} {kind} {detail}: {ast.unparse(node)[:160]}"
        last = node.test.end_lineno if isinstance(node, ast.If) else node.end_lineno
        self.lines = range(node.lineno, last + 1)

    def mutate(self, tree: ast.Module) -> str:
        """Change the module, and return the changed piece."""
        node = list(ast.walk(tree))[self.number]
        match self.kind:
            case "drop":
                for parent in ast.walk(tree):
                    for field in ("body", "orelse", "finalbody"):
                        block = getattr(parent, field, None)
                        if isinstance(block, list) and node in block:
                            block[block.index(node)] = ast.copy_location(ast.Pass(), node)
                return "pass"
            case "turn":
                node.ops[self.detail] = TURNED[type(node.ops[self.detail])]()
            case "condition":
                del node.values[self.detail]
            case "factor":
                node.right, node.op = node.left, ast.BitOr()  # x & y becomes x | x
            case "argument":
                del node.keywords[self.detail]
            case "double":
                node.value = 2 * node.value
        return ast.unparse(node)


def find_sites(room: str) -> list[Site]:
    """All changes of a room, in the order of its files."""
    sites, names = [], Counter()
    for path in sorted((ROOT / "jaxbundle" / room).rglob("*.py")):
        for number, node in enumerate(ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
            for kind, detail in changes(node):
                sites.append(site := Site(path, number, kind, detail, node))
                names[site.name] += 1
                site.name += f" ({names[site.name]})" if names[site.name] > 1 else ""
    return sites


def changes(node: ast.AST) -> list[tuple[str, int]]:
    """The changes of a node that leave a program which may run: kind, and number of the part."""
    match node:
        case ast.AugAssign() | ast.Expr(value=ast.Call()) | ast.If(orelse=[]):
            return [("drop", 0)]
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return [("drop", 0)]
        case ast.Compare():
            return [("turn", k) for k in range(len(node.ops))]
        case ast.BoolOp():
            return [("condition", k) for k in range(len(node.values))]
        case ast.BinOp(op=ast.BitAnd()):
            return [("factor", 0)]
        case ast.Call():
            return [("argument", k) for k, word in enumerate(node.keywords) if word.arg]
        case ast.Constant(value=float()) if node.value:
            return [("double", 0)]
        case ast.Constant(value=int()) if node.value > 2 and node.value is not True:
            return [("double", 0)]
    return []


@functools.cache
def read_file(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def examine(site: Site, executed: dict, seconds: float) -> dict:
    """Run the tests that execute the line on a copy of the package with the change."""
    begin, source = time.monotonic(), site.path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    inside = {k for node in functions for k in range(node.body[0].lineno, node.end_lineno + 1)}
    # Lines outside functions, such as defaults, are executed when the module is imported: tests of
    # its functions, and of files that name it, may notice them.
    in_function = site.lines[0] in inside
    lines = set(site.lines) if in_function else inside
    module = site.file.removesuffix(".py").replace("/", ".")
    reaching = [
        (found["seconds"], test)
        for test, found in executed.items()
        if lines & set(found["lines"].get(site.file, ()))
        or not in_function
        and module in read_file(ROOT / test.split("::")[0])
    ]
    limits, total = {}, 0.0
    for duration, test in sorted(reaching):
        total += duration
        if total < seconds or not limits:
            limits[test] = max(LEAST, TIMES_AS_LONG * duration)
    if any((ROOT / test.split("::")[0]).stat().st_mtime > BEGIN for test in limits):
        sys.exit("a test file has changed: start again")
    change = site.mutate(tree)
    with TemporaryDirectory(prefix="mutant") as folder:
        # With its byte code, which is valid for unchanged files.
        shutil.copytree(ROOT / "jaxbundle", Path(folder, "jaxbundle"))
        changed = ast.unparse(ast.fix_missing_locations(tree))
        Path(folder, site.file).write_text(changed, encoding="utf-8")
        noticed = run_tests_in_child(limits, folder) if limits else None
    return {
        "mutant": site.name, "place": f"{site.file}:{site.lines[0]}", "change": change[:160],
        "lines": source.splitlines()[site.lines[0] - 1 : site.lines[-1]], "noticed": noticed,
        "tests": len(limits), "reaching": len(reaching), "took": time.monotonic() - begin,
    }  # fmt: skip


# ------------------------------------------------------------------------------- the tests


def run_in_child(function, *arguments):
    """Start a function that sends its results to a connection, in a process with what is imported
    here, and return process and connection."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    def run() -> None:
        os.setsid()  # so that it ends with the processes that it has started
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        sys.dont_write_bytecode = True
        function(there, *arguments)

    (process := context.Process(target=run)).start()
    there.close()
    return process, here


def run_pytest(tests: list[str], plugin: object, *options: str) -> int:
    settings = ("-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning")
    paths = [str(ROOT / test) for test in tests]
    return pytest.main([*settings, *options, "--rootdir", str(ROOT), *paths], [plugin])


def run_tests_in_child(limits: dict[str, float], folder: str) -> str | None:
    """The first test that fails with the package of a folder, or takes longer than its limit."""

    def run(connection) -> None:
        class Teller:
            def pytest_runtest_logstart(self, nodeid):
                connection.send(nodeid)

        sys.path.insert(0, folder)
        os.environ["PYTHONPATH"] = folder
        connection.send(int(run_pytest(list(limits), Teller(), "-x")))

    process, connection = run_in_child(run)
    test, status = "the import of the package", None
    try:
        while status is None and connection.poll(limits.get(test, 2 * LEAST)):
            match connection.recv():
                case int(number):
                    status = number
                case name:
                    test = name
    except EOFError:  # the process has died
        pass
    os.killpg(process.pid, signal.SIGKILL)
    process.join()
    return None if status == 0 else test


def what_tests_execute(names) -> dict:
    """Of every test that passes the seconds that it takes alone, with its fixtures, and the lines
    of the package that it executes by file."""
    CACHE.mkdir(parents=True, exist_ok=True)
    executed = {}
    for name in names:
        folder = ROOT / "tests" / name
        for path in [folder] if folder.is_file() else sorted(folder.rglob("test_*.py")):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
            kept = CACHE / f"{path.stem}.{digest}.json"
            if not kept.exists():
                begin = time.monotonic()
                _, connection = run_in_child(record_tests, str(path.relative_to(ROOT)))
                kept.write_text(json.dumps(connection.recv()), encoding="utf-8")
                print(f"{path.name}: {time.monotonic() - begin:.0f} s", flush=True)
            executed |= json.loads(kept.read_text(encoding="utf-8"))
    return executed


def record_tests(connection, file: str) -> None:
    """Run the tests of a file, and send what they execute."""
    from coverage import Coverage

    coverage = Coverage(data_file=None, config_file=False, include=[f"{ROOT}/jaxbundle/*"])
    recorder = Recorder(coverage)
    coverage.start()
    run_pytest([file], recorder, "-m", "not further")
    coverage.stop()
    data, lines = coverage.get_data(), {}
    for path in data.measured_files():
        for line, contexts in data.contexts_by_lineno(path).items():
            for context in contexts:
                of_context = lines.setdefault(context, {})
                of_context.setdefault(str(Path(path).relative_to(ROOT)), []).append(line)
    executed = {}
    for test, fixtures in recorder.fixtures.items():
        parts = [test, *(name for name in fixtures if name in recorder.seconds)]
        together: dict[str, set] = {}
        for part in parts:
            for path, numbers in lines.get(part, {}).items():
                together.setdefault(path, set()).update(numbers)
        executed[test] = {
            "seconds": sum(recorder.seconds[part] for part in parts),
            "lines": {path: sorted(numbers) for path, numbers in together.items()},
        }
    connection.send(executed)


class Recorder:
    """A pytest plugin that tells `coverage` which test or fixture runs. Functions are traced again
    for every test, as they are when it runs alone."""

    def __init__(self, coverage):
        self.coverage, self.running = coverage, [""]
        self.seconds, self.fixtures = Counter(), {}

    def _run(self, name: str):
        begin = time.monotonic()
        self.running.append(name)
        self.coverage.switch_context(name)
        result = yield
        self.running.pop()
        self.coverage.switch_context(self.running[-1])
        self.seconds[name] += (elapsed := time.monotonic() - begin)
        self.seconds[self.running[-1]] -= elapsed
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        jax.clear_caches()
        return (yield from self._run(item.nodeid))

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        return (yield from self._run(f"fixture {fixturedef.argname}"))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        result = yield  # raises where the test fails or is skipped
        self.fixtures[item.nodeid] = [f"fixture {name}" for name in item.fixturenames]
        return result


if __name__ == "__main__":
    sys.exit(main())
