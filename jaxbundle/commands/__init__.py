"""The commands as functions: what the command line computes, with the same names and options.

They are names of `jaxbundle` (`jaxbundle.surface`, `jaxbundle.plan`, …), those about line scanners
of `jaxbundle.pushbroom`. They read their inputs from files and return a result; `jaxbundle.cli`
calls them and writes files.
"""

__all__: list[str] = []
