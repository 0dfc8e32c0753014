"""Training of the embedded judge: data, segmenter, temporal networks, heads."""
