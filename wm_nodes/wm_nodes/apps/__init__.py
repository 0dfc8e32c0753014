"""What a person starts, one verb per module: it parses, calls and prints."""

import sys

if sys.argv[:1] == ["-m"]:  # so it is while Python looks for the module of `python -m wm_nodes.apps.collect`
    module = next((word.removeprefix("-m") for word in sys.orig_argv if f"{__name__}." in word), "")
    if module and module.rpartition(".")[2] not in {"cli", "help"}:
        from wm_nodes.apps.cli import refuse_module

        refuse_module(module)
