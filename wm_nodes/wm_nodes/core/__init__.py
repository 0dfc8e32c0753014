"""Shared vocabulary and small tools that import nothing of ours but config."""
