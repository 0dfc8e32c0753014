"""The reward agent: judges clips by planning, gates, votes and reflection; its evidence, backends and audit log."""
