"""Endogenous evidence of a clip: named numbers that need no download and no GPU (RA-17).

`clip_evidence` is what the embedded judge reads: pixels alone, and pixels through the masks of a small segmenter. What
the world models say of a clip (surprise, reconstruction, inverse dynamics) is in wm_nodes.judge.evidence.world_model.
"""
