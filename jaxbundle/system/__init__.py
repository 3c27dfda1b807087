"""The machine: files, temporary files, interrupts, and JAX settings."""
