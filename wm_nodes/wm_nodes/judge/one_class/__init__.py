"""The embedded judge: numbers of a clip, and what they are in clips in which nothing is wrong (RA-27)."""
