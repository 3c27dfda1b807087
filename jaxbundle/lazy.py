"""Public names of a package that are imported on first use (PEP 562)."""

import importlib


def import_on_use(package: dict, homes: dict[str, tuple[str, ...]]) -> tuple:
    """`__getattr__`, `__dir__` and `__all__` of a package, given its `globals()` and the names of
    each module. Its subpackages are imported on use as well."""
    module = {name: home for home, names in homes.items() for name in names}

    def get(name: str):
        if name not in module and not name.startswith("_"):
            room = f"{package['__name__']}.{name}"
            try:
                return importlib.import_module(room)
            except ModuleNotFoundError as error:
                if error.name != room:
                    raise
        if name not in module:
            from difflib import get_close_matches  # not above: interrupts are handled by now

            title, close = package["__name__"], []
            if not name.startswith("_"):
                close = get_close_matches(name, module, 1)
            mean = f"; did you mean {close[0]!r}?" if close else ""
            raise AttributeError(f"module {title!r} has no attribute {name!r}{mean}")
        value = getattr(importlib.import_module(module[name]), name)
        package[name] = value
        return value

    def list_names() -> list[str]:
        from pkgutil import iter_modules  # likewise

        rooms = {names.name for names in iter_modules(package["__path__"]) if names.ispkg}
        return sorted({*package, *module, *rooms})

    return get, list_names, [*module]
