"""The reward agent: plans, gates, votes and reflects over one Judge (RA-1 to RA-16)."""
