"""What follows from a solution: cofactors, redundancy, tests, weights, derivatives."""
