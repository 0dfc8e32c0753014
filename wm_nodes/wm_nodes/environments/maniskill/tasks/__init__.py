"""The tasks in ManiSkill, one file each. To add a task, add a file; no other file changes.

1. Write <name>.py, here, or anywhere with its path or its package in the environment variable WM_TASKS (several are
   separated by commas), for example `WM_TASKS=my_robot.tasks`. The file's name is the task's: the command lines and
   launch files offer it, and `unknown task` names it.
2. In it, TASK = Task(...), whose fields are explained in config/tasks.py. Take push_cube.py as a pattern: a task on
   the same table shares its scene, ground truth and scripts (table_top.py, behaviours.py) and says what differs. A
   task with a scene of its own returns the class of a ManiSkill environment from `scene`, and says in `measure` and
   `ground_truth_names` what the simulator knows. A robot's task has no simulator: TASK = Task(instruction="...").
3. Import the simulator inside `scene` alone: a world model, a judge or a launch file reads the task without one.
4. Train a world model for it: `python3 launch_scripts/online_rl.py --from-scratch --task <name>`. Its settings go in
   `settings`; its rubric pack, where it has one, is the setting judge.rubric.
5. One policy for several tasks: a file whose TASK has `parts`, as all_tasks.py. A reset's seed chooses the task, the
   state says which it is, and `python3 launch_scripts/online_rl.py --task all_tasks` reports the success of each.

    TASK = replace(
        push_cube.TASK, instruction="push the blue cube off the table", success=cube_fell,
        model=ModelPart(positions=table_top.POSITIONS), settings={"sft.num_demonstrations": 6}, judge=JudgePart(),
    )
"""
