"""Files and folders written completely or not at all, and fingerprints of their inputs."""
