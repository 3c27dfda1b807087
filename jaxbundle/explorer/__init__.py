"""The explorer: an interactive page on the loopback address (`jaxbundle explore`).

An `ExplorerView` defines what its page shows, answers changes of its controls, and provides files
to download; a `Server` connects it to a browser. The page draws the answers of the server: no
formula of the library is repeated in a script.

    from jaxbundle.explorer import NetworkView, Server

    server = Server(NetworkView(jaxbundle.adjust(network)))
    print(server.address)
    server.serve_forever()
"""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.explorer.server": ("Server",),
    "jaxbundle.explorer.network": ("NetworkView",),
    "jaxbundle.explorer.camera": ("CameraView",),
    "jaxbundle.explorer.scanner": ("FlightView",),
    "jaxbundle.explorer.widget": ("show",),
    "jaxbundle.explorer.view": ("ExplorerView",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
