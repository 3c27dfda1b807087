"""From residuals to reduced normal equations: Jacobian, normal blocks, elimination, factors."""
