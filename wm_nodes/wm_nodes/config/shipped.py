"""The models inside the package. Standard library only: launch files ask before torch is needed."""

import json
from importlib import resources
from pathlib import Path

from wm_nodes.config.tasks import parts_of, task_names

PRETRAINED = Path(str(resources.files("wm_nodes"))) / "pretrained"


def shipped_model(task: str) -> Path:
    """The folder of the shipped world model that knows `task`.

    Raises:
        FileNotFoundError: none does; says how to train one.
    """
    known: list[str] = []
    wanted = parts_of(task) if task in task_names() else (task,)
    for manifest in sorted(PRETRAINED.glob("*/manifest.json")):
        tasks = json.loads(manifest.read_text(encoding="utf-8")).get("tasks", [])
        if set(wanted) <= set(tasks):
            return manifest.parent
        known += tasks
    raise FileNotFoundError(
        f"no world model is shipped for task {task!r} (shipped: {', '.join(known) or 'none'}); train one with "
        f"`python3 launch_scripts/online_rl.py --from-scratch --task {task}` and name its folder <run>/model"
    )
