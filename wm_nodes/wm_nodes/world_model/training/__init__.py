"""Training of the world models from demonstrations: tokenizer, dynamics, text model, position probe."""
