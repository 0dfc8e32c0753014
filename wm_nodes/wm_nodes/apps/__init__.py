"""What a person starts, one verb per module: it parses, calls and prints."""
