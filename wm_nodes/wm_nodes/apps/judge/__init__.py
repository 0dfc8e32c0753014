"""The verbs `wm judge ...`: what a judge is good for, and how one is made."""
