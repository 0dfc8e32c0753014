"""Parts of the environment node: lock-step and asynchronous stepping, images, the client of a remote environment."""
