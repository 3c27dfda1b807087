"""What observations leave open: motions, the datum defect, its conditions."""
