"""Parts of the recorder node."""
