"""The same step over DDS and in this process, with as many threads on both sides."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from benchmarks.experiment import console
from benchmarks.speed.inputs import Effort, interleave, time_episode, time_steps
from wm_nodes.config.load import dump_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.policy_rl.factories import make_imagined_environment

if TYPE_CHECKING:
    from wm_nodes.nodes.environment.remote_environment import RemoteEnvironment

GRAPH_ENVS, GRAPH_THREADS = 16, 1
"""One torch thread per node is the graph's default; the loop in one process gets as many."""
TIMEOUT_S = 60.0
DOMAINS = range(60, 102)


@contextmanager
def remote_environments(
    name: str, run_dir: Path, prefixes: Sequence[str], check: Callable[[], None], *, timeout_s: float
) -> Iterator[list["RemoteEnvironment"]]:
    """Environment nodes below /wm, stepped from a node `name` of this process; its executor has a thread of its own."""
    from rclpy.parameter import Parameter

    from wm_nodes.nodes.environment.remote_environment import RemoteEnvironment
    from wm_nodes.ros.clients import RosEnvironmentClient
    from wm_nodes.ros.lifecycle import ManagedNode
    from wm_nodes.ros.spin import init, spinning

    init([])
    node = ManagedNode(name, namespace="/wm", parameter_overrides=[Parameter("run_dir", value=str(run_dir))])
    with spinning(node):
        try:
            clients = [RosEnvironmentClient(node, prefix, timeout_s) for prefix in prefixes]
            yield [RemoteEnvironment(client, check, timeout_s=timeout_s, behaviour=name) for client in clients]
        finally:
            node.stop()


def measure_graph(config: RunConfig, effort: Effort, folder: Path, model: Path, starts: Path) -> dict[str, Any]:
    """graph_overhead: median step over DDS / median step in this process, 16 environments of the default model; the
    median over pairs of episodes that follow each other, since the machine's speed drifts. overhead_95: its interval.
    step_growth: median of the last tenth / of the first tenth of many steps of an environment that costs nothing."""
    from wm_nodes.launching.domain_lock import first_free
    from wm_nodes.launching.graph import Graph, NodeSpec, ParameterValue
    from wm_nodes.launching.runner import Runner

    config_file = folder / "config.yaml"
    config_file.write_text(dump_config(config), encoding="utf-8")
    factory = {"factory": "benchmarks.speed.noop_environment:make_noop_environment"}
    still_file = folder / "still.yaml"
    still_file.write_text(dump_config(config.with_values(environment=factory)), encoding="utf-8")
    common: dict[str, ParameterValue] = {
        "config_file": str(config_file), "run_dir": str(folder), "num_envs": GRAPH_ENVS, "seed": config.seed,
    }
    served: dict[str, ParameterValue] = {"backend": "world_model", "model_dir": str(model), "starts_file": str(starts)}
    still: dict[str, ParameterValue] = {
        "backend": "environment", "config_file": str(still_file),
    }
    module = "wm_nodes.nodes.environment_node"
    graph_nodes = (
        NodeSpec(module, "environment", "/wm", {**common, **served}),
        NodeSpec(module, "environment", "/wm/still", {**common, **still}),
    )
    console.print("graph: starting two environment nodes", highlight=False)
    with ExitStack() as stack:
        lock = first_free(DOMAINS, "the benchmark", group="graph")
        stack.callback(lock.release)
        environment = {"ROS_DOMAIN_ID": str(lock.domain), "OMP_NUM_THREADS": str(GRAPH_THREADS)}
        graph = Graph("benchmark", graph_nodes, environment)
        runner = stack.enter_context(Runner(graph, log=None, log_dir=folder / "logs", use_domain_lock=False))
        runner.wait_ready(TIMEOUT_S)
        os.environ.update(runner.environment)
        remote, still_remote = stack.enter_context(
            remote_environments("benchmark", folder, ("", "still"), runner.check, timeout_s=TIMEOUT_S)
        )
        local = make_imagined_environment(config, model, starts, num_envs=GRAPH_ENVS, seed=config.seed)
        console.print("graph: step over DDS against the same step in one process", highlight=False)
        contenders = [lambda block: time_episode(remote, block), lambda block: time_episode(local, block)]
        with ExitStack() as after:
            after.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(GRAPH_THREADS)
            over_dds, in_process = interleave(contenders, effort.overhead_blocks)
        console.print(f"graph: {effort.growth_steps} steps of a costless environment", highlight=False)
        growth_s = time_steps(still_remote, effort.growth_steps)
    tenth = max(1, len(growth_s) // 10)
    first, last = float(np.median(growth_s[:tenth])), float(np.median(growth_s[-tenth:]))
    fastest = [1e3 * float(np.quantile(part, 0.1)) for part in (growth_s[:tenth], growth_s[-tenth:])]
    dds, alone = float(np.median(np.concatenate(over_dds))), float(np.median(np.concatenate(in_process)))
    ratios = np.array([np.median(a) / np.median(b) for a, b in zip(over_dds, in_process, strict=True)])
    spread = min(0.5, 0.98 / np.sqrt(len(ratios)))  # half of 1.96 / sqrt(n): the rank interval of a median
    return {
        "graph_overhead": float(np.median(ratios)),
        "step_growth": last / first,
        "graph": {
            "num_envs": GRAPH_ENVS, "threads_each": GRAPH_THREADS,
            "image": f"{local.spec.height}x{local.spec.width}", "dds_step_ms": 1e3 * dds,
            "in_process_step_ms": 1e3 * alone, "steps_each": int(sum(map(len, over_dds))), "pairs": len(ratios),
            "overhead_95": np.quantile(ratios, [0.5 - spread, 0.5 + spread]).tolist(),
            "growth_steps": len(growth_s), "growth_first_ms": 1e3 * first, "growth_last_ms": 1e3 * last,
            "growth_first_p10_ms": fastest[0], "growth_last_p10_ms": fastest[1],
        },
    }
