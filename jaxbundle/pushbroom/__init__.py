"""Line scanners: from trajectory and optics to the ground and back."""
