"""ROS nodes: each reads parameters, builds objects and connects callbacks.

Start one by `python -m wm_nodes.nodes.<name>_node`; README.md lists parameters and topics of each.
"""
