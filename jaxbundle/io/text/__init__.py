"""Text: tables of comma-separated values, TOML, JSON, XML; what is wrong is said with its place."""
