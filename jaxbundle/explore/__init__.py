"""The explorer: one page on the loopback address over the real code (`jaxbundle explore`).

A `View` says what its page shows, answers the values of its controls, and gives files to take away
(`view`); `server` brings it to a browser and nothing else does. What the page draws is what the
server answers: no formula of the library is written a second time in a script.

    from jaxbundle.explore.network import NetworkView
    from jaxbundle.explore.server import Server

    server = Server(NetworkView(jaxbundle.adjust(network)))
    print(server.address)
    server.serve_forever()
"""
