"""Parts of the policy node: weights by version, asynchronous actions."""
