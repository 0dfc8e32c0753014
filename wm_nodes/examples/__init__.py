"""One file for each thing of your own: copy it, change it, and name it in the settings."""
