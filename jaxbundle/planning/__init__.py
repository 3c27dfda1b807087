"""Networks before there are photographs: stations, targets, simulated and rendered measurements."""
