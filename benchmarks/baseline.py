"""Figures of `bal.py` against those committed in `baseline.json`: tight on cost, loose on time.

An entry is keyed by everything that determines its cost: the problem (kind, images, points and seed
of a synthetic one; name and digest of a file) and the settings of the solver. Costs agree to 1e-6:
a higher one is wrong, a lower one says that the baseline is stale. The ratio of an iteration to
pycolmap's may grow by a factor of three; if pycolmap is missing on either side, the wall-clock time
by a factor of four.
"""

import hashlib
import json
from pathlib import Path

FILE = Path(__file__).parent / "baseline.json"
TIGHT = 1e-6
SLOWER, SLOWER_BESIDE = 4.0, 3.0
"""Relative to pycolmap, a factor of 1.9 was observed between two hours on one shared machine."""
PEER = "pycolmap"
KEPT = ("cost", "at_limit", "evaluations", "reduction", "iteration_s")


def name_of_file(path: Path, plain: Path) -> str:
    """Name of a BAL problem, with a digest of its unpacked text."""
    digest = hashlib.sha256(plain.read_bytes()).hexdigest()[:16]
    return f"{path.name.split('.')[0]}, sha256 {digest}"


def key_of(problem: str, settings: dict) -> str:
    """Everything that determines a cost, in words."""
    return ", ".join([problem, *(f"{name} {value}" for name, value in settings.items())])


def _entry(found: dict) -> dict:
    figures = found["ours"]
    machine = figures["machine"]
    entry = {name: figures[name] for name in KEPT}
    entry |= {"devices": machine["devices"], "device_kind": machine["device_kind"]}
    if found.get(PEER, {}).get("iteration_s"):
        entry["beside_pycolmap"] = figures["iteration_s"] / found[PEER]["iteration_s"]
    return entry


def agrees(found: dict) -> bool:
    """Whether there is an entry, and the cost is no higher than there."""
    baseline = json.loads(FILE.read_text()) if FILE.exists() else {}
    then = baseline.get(found["key"])
    return bool(then) and found["ours"]["cost"] <= (1 + TIGHT) * then["cost"]


def compare(all_found: list[dict]) -> tuple[list[str], list[str]]:
    """Errors, and remarks."""
    baseline = json.loads(FILE.read_text()) if FILE.exists() else {}
    wrong, known = [], []
    for found in all_found:
        key = found["key"]
        if key not in baseline:
            known.append(f"no baseline for {key} (--write-baseline makes one)")
            continue
        now, then = _entry(found), baseline[key]
        costs = f"{key}: cost {now['cost']:.6f}, {then['cost']:.6f} in the baseline"
        if not now["cost"] <= (1 + TIGHT) * then["cost"]:
            wrong.append(costs)
        elif now["cost"] < (1 - TIGHT) * then["cost"]:
            known.append(f"{costs}: the baseline is stale (--write-baseline)")
        if now["at_limit"] and not then["at_limit"]:
            wrong.append(f"{key}: stopped at the limit of evaluations, not so in the baseline")
        if now["reduction"] != then["reduction"]:
            wrong.append(f"{key}: reduction {now['reduction']}, "
                         f"{then['reduction']} in the baseline")  # fmt: skip
        if now["device_kind"] != then["device_kind"]:
            known.append(f"{key}: times not compared: {now['device_kind']}, "
                         f"{then['device_kind']} in the baseline")  # fmt: skip
            continue
        beside = "beside_pycolmap"
        if beside in now and beside in then:
            if not now[beside] <= SLOWER_BESIDE * then[beside]:
                wrong.append(
                    f"{key}: an iteration takes {now[beside]:.2f} of pycolmap's, "
                    f"{then[beside]:.2f} in the baseline"
                )
        elif not now["iteration_s"] <= SLOWER * then["iteration_s"]:
            wrong.append(
                f"{key}: {1e3 * now['iteration_s']:.1f} ms an iteration, "
                f"{1e3 * then['iteration_s']:.1f} in the baseline"
            )
    return wrong, known


def write(all_found: list[dict]) -> None:
    """Keep these figures, with those of other problems."""
    baseline = json.loads(FILE.read_text()) if FILE.exists() else {}
    baseline |= {found["key"]: _entry(found) for found in all_found}
    text = json.dumps(baseline, indent=1, sort_keys=True, ensure_ascii=False)
    FILE.write_text(text + "\n", encoding="utf-8")
