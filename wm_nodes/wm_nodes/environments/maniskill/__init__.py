"""ManiSkill scenes, tasks, cameras, planner and collection: the only place that imports mani_skill, sapien or mplib."""
