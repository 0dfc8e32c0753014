"""The shapes of the scenes' objects, one file each. To add a shape, add a file; no other file changes.

1. Write <name>.py, here or in a package of your own whose name is in the environment variable WM_SHAPES (several are
   separated by commas), for example `WM_SHAPES=my_robot.shapes`. The name is one lower-case word.
2. In it, SHAPE = Shape(...), whose fields are explained in environments/maniskill/shape.py; sphere.py is a pattern.
   Meshes are as good as primitives: the builder is SAPIEN's. The gripper opens to 8 cm.
3. Its scenes are of every colour, container and table, in no split: `--simulation.scenes red_<name>-bowl-grey_table`.
"""
