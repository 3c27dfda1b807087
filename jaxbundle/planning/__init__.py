"""Networks before there are photographs: rendered photographs of known surfaces."""
