"""Line scanner images: our file, flights, refinements, and the products of agencies."""
