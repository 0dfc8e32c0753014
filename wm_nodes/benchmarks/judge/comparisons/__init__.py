"""Rewards of other papers on the same clips, to compare the agent with: what is public of them, and what is ours.

- VideoAlign (arXiv 2501.13918, KwaiVGI/VideoAlign). Public: Qwen2-VL with three reward tokens and a linear head; VQ,
  MQ, TA, each less its mean over its deviation, summed; 2 frames per second; the criteria of its detailed prompt. Ours:
  the chat form, which asks any model for 0 to 10 on each. The head itself, from a local folder: video_reward.
- UnifiedReward (CodeGoat24/UnifiedReward). Public: pointwise, 8 frames, five dimensions 1 to 4 and "Final Score" 1 to
  10 as text lines; Flex, pairwise, 8 frames of each video, three categories of sub-dimensions that the model chooses,
  two scores that sum to 10 each, a winner, as JSON. Its models are chat models: serve their folder and name it.
- One number: the plainest prompt there is, ours.
- PAI-Bench's robot protocol (arXiv 2512.01989, SHI-Labs/physical-ai-bench): pai_bench says what is known of it;
  `wm benchmark judge pai-bench` runs it over a folder of videos, with local vision backbones.

Criteria, scales and answer forms are the public ones, the wording is ours: no prompt is copied. Numbers may differ from
the authors' by that; quote them as "VideoAlign-style". Every failure is a reason, never a number.
"""
