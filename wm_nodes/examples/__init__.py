"""One file for each thing of your own: copy it to a folder on PYTHONPATH, change it, and name it in the settings.

`python` in their commands is that of the checkout, .venv/bin/python. `wm train-policy` and the launch files take the
same settings, e.g. python3 launch_scripts/wm.py train-policy --reward.factory examples.own_reward:make.
"""
