"""Set-up of everything that the entry points need, standard library only: python3 launch_scripts/setup."""
