"""Second minima of an adjusted network: found in closed form, adjusted, and weighed."""
