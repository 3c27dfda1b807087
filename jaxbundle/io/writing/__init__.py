"""Files and folders written whole or not at all, and fingerprints of what they were made of."""
