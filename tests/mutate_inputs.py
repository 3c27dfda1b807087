"""Damage to the input of every reader, in processes of their own: tracebacks, aborts, hangs.

    python tests/mutate_inputs.py [CASES] [--seed N] [--readers WORD …] [--first N] [--workers N]

CASES damaged inputs a reader (300), those of `tests/io/test_mutations.py` with its seed. A process
may take 60 s of processor a case, and 3 GB beyond what it has when it starts; one that ends or does
not come back is replaced and the case is named. Exit status 1 if any case ends otherwise than in a
result or an `InputError` in one line that names the file.
"""

import argparse
import collections
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

TESTS = Path(__file__).parent
FOLDERS = ("io", "pushbroom", "photographs", "surfaces", "measure", "adjustment", "reconstruction")
sys.path += [str(TESTS.parent), *(str(TESTS / name) for name in FOLDERS)]
SECONDS, MEMORY = 60, 3 << 30


def work() -> None:
    """Read "reader number seed" lines from standard input; an answer a line."""
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(TESTS.parent / ".cache" / "jax"))
    import warnings

    warnings.simplefilter("ignore")
    # native code prints to standard output, too: LAPACK about NaN
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import jaxbundle

    jaxbundle.enable_x64()
    from readers import READERS
    from test_mutations import check_case

    valid = {}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        for line in sys.stdin:
            reader, number, seed = line.rstrip("\n").split("\t")
            if reader not in valid:
                valid[reader] = root / f"valid{len(valid)}"
                valid[reader].mkdir()
                READERS[reader].make(valid[reader])
                READERS[reader].read(valid[reader])
                resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                limit = pages * resource.getpagesize() + MEMORY
                resource.setrlimit(resource.RLIMIT_AS, (limit, -1))
            begin, folder = time.process_time(), tempfile.mkdtemp(dir=root)
            try:
                said = check_case(reader, Path(folder), valid[reader], int(number), int(seed))
                kind = "refused" if ": refused: " in said else "read"
            except BaseException as error:
                last = traceback.extract_tb(error.__traceback__)
                where = next((f for f in reversed(last) if "/jaxbundle/" in f.filename), last[-1])
                place = f"{Path(where.filename).name}:{where.lineno}"
                told = " ".join(str(error).split())[:200]
                kind, said = "traceback", f"{type(error).__name__} {place} {told}"
            spent = time.process_time() - begin
            subprocess.run(["rm", "-rf", folder], check=True)
            print(kind, f"{spent:.2f}", " ".join(said.split()), sep="\t", file=answers, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=int, nargs="?", default=300)
    parser.add_argument("--seed", type=int, default=37)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--readers", nargs="*", default=[])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="every refusal")
    parser.add_argument("--work", action="store_true")
    given = parser.parse_args()
    if given.work:
        work()
        return 0
    from readers import READERS

    names = [n for n in READERS if not given.readers or any(w in n for w in given.readers)]
    numbers = range(given.first, given.first + given.cases)
    queue = collections.deque((n, k) for n in names for k in numbers)
    counts, slowest, failed = collections.Counter(), (0.0, ""), []
    running: dict[int, tuple[subprocess.Popen, str, int, float]] = {}

    def start() -> subprocess.Popen:
        command = [sys.executable, __file__, "--work"]
        # a session of its own, and what native code says beside the answers
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                                stderr=subprocess.DEVNULL)  # fmt: skip

    def give(process: subprocess.Popen) -> None:
        if queue:
            name, number = queue.popleft()
            process.stdin.write(f"{name}\t{number}\t{given.seed}\n")
            process.stdin.flush()
            running[process.stdout.fileno()] = process, name, number, time.time()
        else:
            process.stdin.close()

    for _ in range(min(given.workers, len(queue))):
        give(start())
    while running:
        ready, *_ = select.select(list(running), [], [], 5)
        late = [f for f, (*_, begin) in running.items() if time.time() - begin > 4 * SECONDS]
        for file in {*ready, *late}:
            process, name, number, _ = running.pop(file)
            line = process.stdout.readline() if file in ready else ""
            if not line:
                process.kill()
                status = process.wait()
                kind, spent, said = ("abort" if file in ready else "hang"), "0", f"status {status}"
                process = start()
            else:
                kind, spent, said = line.rstrip("\n").split("\t", 2)
            if float(spent) > SECONDS:
                kind, said = "slow", f"{spent} s: {said}"
            counts[kind] += 1
            slowest = max(slowest, (float(spent), f"{name} {number}"))
            if kind not in ("read", "refused"):
                failed.append((name, number))
            if given.show or (kind not in ("read", "refused")):
                print(f"{kind}: {name}, case {number}: {said}", flush=True)
            give(process)
    print(f"{len(names)} readers, {sum(counts.values())} cases, seed {given.seed}: {dict(counts)}; "
          f"the slowest {slowest[0]:.1f} s ({slowest[1]})")  # fmt: skip
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
