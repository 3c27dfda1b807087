"""The machine a figure was measured on; shared by all benchmarks: arguments, figures as JSON."""

import argparse
import importlib.util
import json
import os
import re
import resource
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "pycolmap", "opencv-python-headless")


def parser_of(description: str) -> argparse.ArgumentParser:
    """An argument parser whose help is the docstring of the program, unchanged."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def solver_parser(description: str, evaluations: int = 200, repeat: int = 2):
    """An argument parser for a program that runs one solver on one BAL problem."""
    parser = parser_of(description)
    parser.add_argument("problem")
    parser.add_argument("--evaluations", type=positive, default=evaluations)
    parser.add_argument("--repeat", type=positive, default=repeat)
    return parser


def positive(text: str) -> int:
    """A positive integer of the command line."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return int(text)


def target(text: str) -> str:
    """An output file of the command line, checked before anything is measured."""
    if text != "-" and (Path(text).is_dir() or not Path(text).absolute().parent.is_dir()):
        raise argparse.ArgumentTypeError(f"{text} is a folder, or its folder does not exist")
    return text


def verdict(wrong: list[str]) -> int:
    """Print the errors; returns the exit status."""
    for line in wrong:
        print(f"WRONG: {line}", file=sys.stderr)
    return 1 if wrong else 0


def machine() -> dict:
    """Devices of JAX, precision, versions, threads; JAX must have been set up before."""
    import jax

    devices = jax.devices()
    return {
        "device_kind": devices[0].device_kind,
        "platform": devices[0].platform,
        "devices": len(devices),
        "float64": bool(jax.config.jax_enable_x64),
        "cores": cores(),
        "openblas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "not set"),
        "load": round(os.getloadavg()[0], 1),
        "versions": {"python": sys.version.split()[0]} | {
            name: number for name in PACKAGES if (number := version_of(name))
        },
    }  # fmt: skip


def in_words(found: dict) -> str:
    """One line for the head of a table."""
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    return (
        f"{found['devices']} × {found['device_kind']} ({found['platform']}), "
        f"float{64 if found['float64'] else 32}, {found['cores']} cores at load {found['load']}, "
        f"OPENBLAS_NUM_THREADS {found['openblas_threads']}; {versions}"
    )


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def version_of(package: str) -> str | None:
    """Version of an installed package; None if it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def installed(module: str) -> bool:
    """Whether a module can be imported."""
    return importlib.util.find_spec(module) is not None


def peak_mb(who: int = resource.RUSAGE_SELF) -> float:
    """Largest resident memory so far of this process, or of its children, in MB."""
    status = Path("/proc/self/status")
    # Linux counts the memory of the parent too in `getrusage` of a process it started.
    if who == resource.RUSAGE_SELF and status.exists():
        return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) * 1024 / 1e6
    size = resource.getrusage(who).ru_maxrss
    return size * (1 if sys.platform == "darwin" else 1024) / 1e6


def device_peak_mb() -> float | None:
    """Largest memory in use so far on an accelerator, in MB; None on CPUs."""
    import jax

    found = jax.devices()[0].memory_stats()
    return found["peak_bytes_in_use"] / 1e6 if found else None


def write_json(figures, target: str | None) -> None:
    """Figures into a file, or on standard output for "-"; nothing without a target."""
    text = json.dumps(figures, indent=1) + "\n"
    if target == "-":
        sys.stdout.write(text)
    elif target:
        Path(target).write_text(text, encoding="utf-8")
