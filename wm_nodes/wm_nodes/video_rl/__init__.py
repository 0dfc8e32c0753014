"""GRPO post-training of the video world model (loop 2). Start with train.py."""
