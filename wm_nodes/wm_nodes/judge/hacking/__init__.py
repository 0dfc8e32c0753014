"""Edits that spoil a clip by its pixels alone, to see whether a judge still pays it (spec of the method, 3.1)."""
