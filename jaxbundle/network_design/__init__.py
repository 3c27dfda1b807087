"""Design of networks by gradient: datum, configuration, weights, the next photograph."""
