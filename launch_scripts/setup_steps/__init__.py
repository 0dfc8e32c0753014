"""The steps of wm_setup.py, standard library only: interpreter, system packages, Python packages, messages, stamp."""
