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


def _require_of_all(
    population: Population, name: str, is_known: Bool[np.ndarray, " inputs"]
) -> None:
    """Refuse a number that an input with a result lacks: what a result does not have is not
    accepted.

    **Raises:** `LookupError` naming the inputs."""
    if not population.solved.any():
        raise LookupError("no input has a result")
    missing_keys = population.keys[population.solved & ~is_known]
    if len(missing_keys):
        words = f"the result of {list_some(missing_keys.tolist(), as_text=str)} has no {name}"
        raise MissingNumber(words, tuple(missing_keys.tolist()))


def _number(name: str, unit: str = "") -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, _: str) -> QuantityValues:
        population: Population = subject.result
        values = population.numbers[name]
        _require_of_all(population, name, np.asarray(np.isfinite(values)))
        solved = zip(
            population.keys[population.solved].tolist(), values[population.solved].tolist()
        )
        return QuantityValues(dict(solved), unit)

    return find


def _parameter(column: str) -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, argument: str) -> QuantityValues:
        """The values or σ of a parameter; of an input with several cameras ("left fx") of each."""
        population: Population = subject.result
        columns = {"value": population.values, "sigma": population.sigma}[column]
        # A rig has "left fx", "right fx": fx is that of every camera.
        names = [n for n in columns if argument in (n, n.rpartition(" ")[2])]
        if not names:
            known_columns = ", ".join(columns) or "none"
            raise LookupError(f"no input has an estimated {argument}; known: {known_columns}")
        numbers = np.array([columns[name] for name in names])
        _require_of_all(population, argument, np.asarray(np.isfinite(numbers).any(0)))
        named_values = {
            (name, key): float(value)
            for name, row in zip(names, numbers)
            for key, value in zip(population.keys, row)
            if np.isfinite(value)
        }
        label = lambda name, key: f"{name} of {key}"
        # Cameras of several models may share a file of results.
        units = {unit_of_parameter(m, argument.rpartition(" ")[2]) for m in population.models}
        if len(units) > 1:
            raise LookupError(f"{argument} has different units: {', '.join(sorted(units))}")
        return QuantityValues(
            {label(*name_and_key): value for name_and_key, value in named_values.items()},
            units.pop() if units else "",
            owners={label(*name_and_key): name_and_key[1] for name_and_key in named_values},
        )

    return find


def _share(which: str) -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, _: str) -> QuantityValues:
        """The share of the inputs, and which are missing."""
        population: Population = subject.result
        good = {"solved": population.solved, "converged": population.fit}[which]
        if not len(good):
            raise LookupError("there are no inputs")
        # Named, because a share alone says nobody which input to look at.
        other_keys = population.keys[~good].tolist()
        words = (
            f"all but {list_some(other_keys, as_text=str)}"
            if other_keys
            else f"all {len(good)} inputs"
        )
        return QuantityValues({words: float(good.mean())}, owners={words: other_keys})

    return find


def _outlying(subject: Subject, _: str) -> QuantityValues:
    population: Population = subject.result
    return one_value(len(population.outlying()))


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
