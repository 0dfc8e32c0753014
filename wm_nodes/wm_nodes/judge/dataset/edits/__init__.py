"""Clips that are wrong in a known way: recipes on pixels, time and states, their labels, the manifest of a set.

See RA-21. Pure functions of arrays: what renders edited states is elsewhere.
"""
