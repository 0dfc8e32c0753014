"""DynDiff-GRPO against its rivals."""
