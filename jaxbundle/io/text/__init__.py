"""Text: tables of comma-separated values, TOML, JSON, XML; errors name the place."""
