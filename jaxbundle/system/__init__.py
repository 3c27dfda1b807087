"""The machine: files, temporary files, interrupts, and how JAX is to work."""
