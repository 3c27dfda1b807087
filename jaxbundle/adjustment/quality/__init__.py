"""Statistics of an adjusted network: precision, blunders, misfit, weakness, check points."""
