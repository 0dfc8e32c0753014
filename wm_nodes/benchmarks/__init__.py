"""Commands that make the numbers of the documents; not installed. Start them by `wm benchmark`."""
