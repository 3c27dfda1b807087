"""Work shared out to threads."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

# In place of a result, until its item is tried again.
NO_MEMORY = object()


def map_in_threads(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    at_once: int,
    advance: Callable[[int], object] = lambda _count: None,
) -> list[Any]:
    """The results of all items, in their order. An item that finds too little memory beside others
    is tried again alone, after them. `advance(count)`: called after each."""
    items = list(items)

    def attempt(item: Any) -> Any:
        try:
            return function(item)
        except MemoryError:
            if at_once == 1:
                raise
            return NO_MEMORY

    results = []
    with ThreadPoolExecutor(at_once) as pool:
        for result in pool.map(attempt, items):
            results.append(result)
            advance(len(results))
    return [
        function(item) if result is NO_MEMORY else result for item, result in zip(items, results)
    ]
