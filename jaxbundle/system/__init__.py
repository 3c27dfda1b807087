"""The machine: files, temporary files, terminals, interrupts, and JAX settings."""
