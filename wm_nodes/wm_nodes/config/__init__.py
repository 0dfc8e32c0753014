"""Configuration: schema explains, presets hold the numbers."""
