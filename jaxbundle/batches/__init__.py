"""Many cameras of one model, calibrated in one program; many networks in one run."""
