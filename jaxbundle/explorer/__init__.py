"""The explorer: an interactive page on the loopback address (`jaxbundle explore`).

A `ExplorerView` defines what its page shows, answers changes of its controls, and provides files to
download (`view`); `server` connects it to a browser. The page draws the answers of the
server: no formula of the library is repeated in a script.

    from jaxbundle.explorer.network import NetworkView
    from jaxbundle.explorer.server import Server

    server = Server(NetworkView(jaxbundle.adjust(network)))
    print(server.address)
    server.serve_forever()
"""
