"""The machine: files, temporary files, terminals, interrupts, and JAX settings."""

# Internal; the switches of the process are names of `jaxbundle`.
__all__: list[str] = []
