"""Quantities of a batch: of every input that has a result, and of all of them together."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from jaxbundle.adjustment.budget_inputs import unit_of_parameter
from jaxbundle.batches.population import Population
from jaxbundle.certificates.quantity import (
    Quantity,
    QuantityValues,
    Subject,
    one_value,
)
from jaxbundle.network.columns import list_some


class MissingNumber(LookupError):
    """Results of `inputs` without a number that a criterion is about."""

    def __init__(self, words: str, inputs: tuple[str, ...]):
        super().__init__(words)
        self.inputs = inputs


def _require_of_all(found: Population, name: str, known: Bool[np.ndarray, " inputs"]) -> None:
    """Refuse a number that an input with a result lacks: what a result does not have is not
    accepted.

    **Raises:** `LookupError` naming the inputs."""
    if not found.solved.any():
        raise LookupError("no input has a result")
    missing = found.keys[found.solved & ~known]
    if len(missing):
        words = f"the result of {list_some(missing.tolist(), as_text=str)} has no {name}"
        raise MissingNumber(words, tuple(missing.tolist()))


def _number(name: str, unit: str = "") -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, _: str) -> QuantityValues:
        found: Population = subject.result
        values = found.numbers[name]
        _require_of_all(found, name, np.asarray(np.isfinite(values)))
        chosen = zip(found.keys[found.solved].tolist(), values[found.solved].tolist())
        return QuantityValues(dict(chosen), unit)

    return find


def _parameter(what: str) -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, argument: str) -> QuantityValues:
        """The values or σ of a parameter; of an input with several cameras ("left fx") of each."""
        found: Population = subject.result
        columns = {"value": found.values, "sigma": found.sigma}[what]
        # A rig has "left fx", "right fx": fx is that of every camera.
        names = [n for n in columns if argument in (n, n.rpartition(" ")[2])]
        if not names:
            known = ", ".join(columns) or "none"
            raise LookupError(f"no input has an estimated {argument}; known: {known}")
        numbers = np.array([columns[name] for name in names])
        _require_of_all(found, argument, np.asarray(np.isfinite(numbers).any(0)))
        chosen = {
            (name, key): float(value)
            for name, row in zip(names, numbers)
            for key, value in zip(found.keys, row)
            if np.isfinite(value)
        }
        label = lambda name, key: f"{name} of {key}"
        # Cameras of several models may share a file of results.
        units = {unit_of_parameter(m, argument.rpartition(" ")[2]) for m in found.models}
        if len(units) > 1:
            raise LookupError(f"{argument} has different units: {', '.join(sorted(units))}")
        return QuantityValues(
            {label(*of): value for of, value in chosen.items()},
            units.pop() if units else "",
            owners={label(*of): of[1] for of in chosen},
        )

    return find


def _share(which: str) -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, _: str) -> QuantityValues:
        """The share of the inputs, and which are missing."""
        found: Population = subject.result
        good = {"solved": found.solved, "converged": found.fit}[which]
        if not len(good):
            raise LookupError("there are no inputs")
        # Named, because a share alone says nobody which input to look at.
        others = found.keys[~good].tolist()
        words = f"all but {list_some(others, as_text=str)}" if others else f"all {len(good)} inputs"
        return QuantityValues({words: float(good.mean())}, owners={words: others})

    return find


def _outlying(subject: Subject, _: str) -> QuantityValues:
    found: Population = subject.result
    return one_value(len(found.outlying()))


SOLVED = "solved"
OF_BATCH: tuple[Quantity, ...] = (
    Quantity("sigma0", "", "σ0 of every input", _number("sigma0")),
    Quantity("rms", "px", "RMS of an image point", _number("rms", "px")),
    Quantity("redundancy", "", "redundancy", _number("redundancy")),
    Quantity("views", "", "photographs used", _number("views")),
    Quantity("removed", "", "observations removed as blunders", _number("removed")),
    Quantity("sigma(NAME)", "of NAME", "σ of a parameter of the camera", _parameter("sigma")),
    Quantity("value(NAME)", "of NAME", "its value", _parameter("value")),
    Quantity(SOLVED, "", "share of the inputs with a result", _share(SOLVED)),
    Quantity("converged", "", "share that is neither weak nor misfit", _share("converged")),
    Quantity("outlying", "", "number of unusual inputs", _outlying),
)
