"""Speed, side by side in one run: DDS against one process, the world model against the simulator, stage by stage.

Every comparison is interleaved (A B A B ...), so that whatever else the machine does falls on both sides.
"""

import argparse
import ctypes
import json
import os
import platform
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from safetensors.torch import save_file

from wm_nodes.config.load import dump_config, load_config, preset_names
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.control import check_actions, next_state
from wm_nodes.learning.policies import make_endogenous_reward, make_imagined_environment, make_policy, models_of
from wm_nodes.learning.pretraining import MODEL_TASKS
from wm_nodes.learning.rollouts import reward_input
from wm_nodes.reports import machine_facts
from wm_nodes.reports.summary import plain, write_whole
from wm_nodes.reward import RewardInput, RewardModel, RuleReward
from wm_nodes.seeding import numpy_stream, stream_seed
from wm_nodes.simulation.tasks import instruction
from wm_nodes.specs import EnvironmentSpec, simulation_spec
from wm_nodes.types import BoolArray, Environment, FloatArray, Observation, StepResult, UInt8Array, UInt64Array
from wm_nodes.world_model import load_starts, save_model_folder
from wm_nodes.world_model.dynamics import ActionModel, done_signal
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.text import TextModel, vocabulary_of
from wm_nodes.world_model.tokenizer import Tokenizer

GRAPH_ENVS, IMAGINED_ENVS, SIMULATOR_ENVS = 16, 64, 4
NUM_STARTS = 64
TIMEOUT_S = 60.0
DOMAINS = range(60, 102)

console = Console()
T = TypeVar("T")


@dataclass(frozen=True)
class Effort:
    """How much is measured. Blocks are one episode long; a first one of each kind warms up and does not count."""

    overhead_blocks: int
    growth_steps: int
    simulator_blocks: int
    stage_repeats: int


FULL, QUICK = Effort(12, 5000, 5, 30), Effort(3, 500, 2, 8)


def main(argv: Sequence[str]) -> int:
    """Measure, show the table, write --json. Return the exit code: 0 done, 2 a clear error."""
    arguments = _parser().parse_args(argv)
    effort = QUICK if arguments.quick else FULL
    try:
        config = load_config(arguments.preset, {"seed": arguments.seed})
        with tempfile.TemporaryDirectory(prefix="wm_benchmark_") as folder:
            found = measure(config, effort, Path(folder), arguments.model_dir)
    except (ValueError, OSError, RuntimeError) as error:
        console.print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        return 2
    found |= {"quick": arguments.quick, "preset": arguments.preset, "seed": arguments.seed}
    show(found)
    if arguments.json:
        write_whole(arguments.json, json.dumps(plain(found), indent=1) + "\n")
        console.print(f"written {arguments.json}", highlight=False)
    return 0


def measure(config: RunConfig, effort: Effort, folder: Path, model_dir: Path | None = None) -> dict[str, Any]:
    """All four parts. Keys: graph_overhead, step_growth, imagined_over_simulator, imagined_steps_per_s, and details."""
    model, starts, description = prepare_model(config, folder, model_dir)
    console.print(f"world model: {description}; {torch.get_num_threads()} torch threads", highlight=False)
    found: dict[str, Any] = {"model": description, "torch_threads": torch.get_num_threads()}
    found |= measure_graph(config, effort, folder, model, starts)
    found |= measure_simulator(config, effort, model, starts)
    found["stages"] = measure_stages(config, effort, model, starts)
    return {**found, "machine": machine_facts(), "date": time.strftime("%Y-%m-%d"), "platform": platform.platform()}


def prepare_model(config: RunConfig, folder: Path, given: Path | None) -> tuple[Path, Path, str]:
    """Model folder, starts file and a description: the given one, the shipped one, or one of the configuration's size
    with random weights, which cost the same."""
    model_dir = given
    if model_dir is None:
        try:
            model_dir = shipped_model(config.task)
        except FileNotFoundError:
            model_dir = random_model(config, folder / "model")
    shipped = model_dir / "starts.safetensors"
    starts_file = folder / "starts.safetensors"
    if shipped.is_file():
        images, states = (array[:NUM_STARTS] for array in load_starts(shipped))
    else:
        rng = numpy_stream(config.seed, "benchmark_starts")
        size = config.simulation.image_size
        images = rng.integers(0, 256, (NUM_STARTS, size, size * len(config.simulation.cameras), 3), np.uint8)
        low, high = config.simulation.workspace_low_m, config.simulation.workspace_high_m
        states = rng.uniform(low, high, (NUM_STARTS, 3)).astype(np.float32)
    save_file({"images": torch.from_numpy(images.copy()), "states": torch.from_numpy(states.copy())}, starts_file)
    models = models_of(model_dir)
    millions = sum(p.numel() for m in (models.tokenizer, models.action) for p in m.parameters()) / 1e6
    kind = "random weights" if model_dir == folder / "model" else str(model_dir)
    text = "" if models.text is not None else ", no text model (no dense reward)"
    return model_dir, starts_file, f"{kind}, {millions:.2f} M parameters (tokenizer and action model){text}"


def random_model(config: RunConfig, folder: Path) -> Path:
    """A model folder of the configuration's size, untrained."""
    torch.manual_seed(stream_seed(config.seed, "benchmark_model") % 2**31)
    size, tasks = config.simulation.image_size, MODEL_TASKS[config.task]
    tokenizer = Tokenizer(config.tokenizer, size, size * len(config.simulation.cameras))
    sizes = {"num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": len(tasks)}
    action = ActionModel(config.world_model, action_dim=3, state_dim=3, **sizes)
    text = TextModel(config.world_model, vocabulary=vocabulary_of(tuple(map(instruction, tasks))), **sizes)
    return save_model_folder(
        folder, tokenizer, action, text, tokenizer_config=config.tokenizer, world_model_config=config.world_model,
        simulation=config.simulation, tasks=tasks, story={"data": "none: random weights for benchmarks"},
    )  # fmt: skip


# Part 1 and 2: the graph.


def measure_graph(config: RunConfig, effort: Effort, folder: Path, model: Path, starts: Path) -> dict[str, Any]:
    """graph_overhead: median step over DDS / median step in this process, 16 environments of the default model.
    step_growth: median of the last tenth / of the first tenth of many steps of an environment that costs nothing."""
    from wm_nodes.ros.domain import first_free
    from wm_nodes.ros.graph import Graph, NodeSpec, ParameterValue
    from wm_nodes.ros.runner import Runner

    config_file = folder / "config.yaml"
    config_file.write_text(dump_config(config))
    common: dict[str, ParameterValue] = {
        "config_file": str(config_file), "run_dir": str(folder), "num_envs": GRAPH_ENVS, "seed": config.seed,
    }  # fmt: skip
    served: dict[str, ParameterValue] = {"backend": "world_model", "model_dir": str(model), "starts_file": str(starts)}
    still: dict[str, ParameterValue] = {
        "backend": "factory", "backend_factory": "wm_nodes.benchmark:make_still_environment",
    }  # fmt: skip
    module = "wm_nodes.nodes.environment_node"
    graph_nodes = (
        NodeSpec(module, "environment", "/wm", {**common, **served}),
        NodeSpec(module, "environment", "/wm/still", {**common, **still}),
    )
    console.print("graph: starting two environment nodes", highlight=False)
    with ExitStack() as stack:
        lock = first_free(DOMAINS, "the benchmark", group="graph")
        stack.callback(lock.release)
        graph = Graph("benchmark", graph_nodes, {"ROS_DOMAIN_ID": str(lock.domain)})
        runner = stack.enter_context(Runner(graph, log=None, log_dir=folder / "logs", use_domain_lock=False))
        runner.wait_ready(TIMEOUT_S)
        remote, still_remote = stack.enter_context(
            remote_environments(runner.environment, folder, ("", "still"), runner.check)
        )
        local = make_imagined_environment(config, model, starts, num_envs=GRAPH_ENVS, seed=config.seed)
        console.print("graph: step over DDS against the same step in one process", highlight=False)
        over_dds, in_process = interleave(
            [lambda block: time_episode(remote, block), lambda block: time_episode(local, block)],
            effort.overhead_blocks,
        )
        console.print(f"graph: {effort.growth_steps} steps of a costless environment", highlight=False)
        growth_s = time_steps(still_remote, effort.growth_steps)
    tenth = max(1, len(growth_s) // 10)
    first, last = float(np.median(growth_s[:tenth])), float(np.median(growth_s[-tenth:]))
    fastest = [1e3 * float(np.quantile(part, 0.1)) for part in (growth_s[:tenth], growth_s[-tenth:])]
    dds, alone = float(np.median(np.concatenate(over_dds))), float(np.median(np.concatenate(in_process)))
    return {
        "graph_overhead": dds / alone,
        "step_growth": last / first,
        "graph": {
            "num_envs": GRAPH_ENVS, "image": f"{local.spec.height}x{local.spec.width}", "dds_step_ms": 1e3 * dds,
            "in_process_step_ms": 1e3 * alone, "steps_each": int(sum(map(len, over_dds))),
            "growth_steps": len(growth_s), "growth_first_ms": 1e3 * first, "growth_last_ms": 1e3 * last,
            "growth_first_p10_ms": fastest[0], "growth_last_p10_ms": fastest[1],
        },
    }  # fmt: skip


@contextmanager
def remote_environments(
    environment: dict[str, str], folder: Path, prefixes: Sequence[str], alive: Callable[[], None]
) -> Iterator[list[Environment]]:
    """Environment nodes through DDS, from a node of this process whose executor has a thread of its own."""
    os.environ.update(environment)
    import rclpy
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions

    from wm_nodes.nodes.remote_environment import RemoteEnvironment
    from wm_nodes.ros.clients import RosEnvironmentClient
    from wm_nodes.ros.lifecycle import ManagedNode
    from wm_nodes.ros.spin import make_executor, spin

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    run_dir = Parameter("run_dir", value=str(folder))
    node = ManagedNode("benchmark", namespace="/wm", parameter_overrides=[run_dir])
    executor = make_executor("events")
    executor.add_node(node)
    stop = threading.Event()
    thread = threading.Thread(target=spin, args=(executor, stop.is_set), daemon=True)
    thread.start()
    try:
        clients = [RosEnvironmentClient(node, prefix, TIMEOUT_S) for prefix in prefixes]
        yield [RemoteEnvironment(client, alive, timeout_s=TIMEOUT_S, behaviour="benchmark") for client in clients]
    finally:
        node.stop()
        stop.set()
        thread.join()
        executor.remove_node(node)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


class StillEnvironment:
    """N environments of the benchmark's sizes that show noise, never end and cost nothing: the graph's own cost."""

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.spec = spec
        shape = (spec.num_envs, spec.height, spec.width, 3)
        self._images = numpy_stream(0, "still").integers(0, 256, shape, np.uint8)
        middle = (np.asarray(spec.state_low) + np.asarray(spec.state_high)) / 2
        self._start = np.tile(middle.astype(np.float32), (spec.num_envs, 1))
        self._states = self._start.copy()
        self._steps = np.zeros(spec.num_envs, np.uint32)

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        chosen = np.ones(self.spec.num_envs, bool) if mask is None else mask
        self._states[chosen] = self._start[chosen]
        self._steps[chosen] = 0
        return self._observation()

    def step(self, actions: FloatArray) -> StepResult:
        check_actions(actions, self.spec)
        self._states = next_state(self._states, actions, self.spec)
        self._steps = self._steps + np.uint32(1)
        count = self.spec.num_envs
        no, zero = np.zeros(count, bool), np.zeros(count, np.float32)
        truth = np.full((count, self.spec.ground_truth_dim), np.nan, np.float32)
        return StepResult(self._observation(), no, no.copy(), zero, zero.copy(), truth, ~no)

    def goals(self) -> tuple[UInt8Array, BoolArray] | None:
        return None

    def close(self) -> None:
        self._steps[:] = 0

    def _observation(self) -> Observation:
        ids = np.arange(1, self.spec.num_envs + 1, dtype=np.uint64)
        return Observation(self._images, self._states.copy(), ids, self._steps.copy())


def make_still_environment(config: RunConfig, num_envs: int, seed: int) -> StillEnvironment:
    """backend_factory of the second environment node."""
    return StillEnvironment(simulation_spec(config.task, instruction(config.task), config.simulation, num_envs))


# Part 3: world model against simulator.


def measure_simulator(config: RunConfig, effort: Effort, model: Path, starts: Path) -> dict[str, Any]:
    """imagined_steps_per_s: environment steps with reward, 64 imagined environments; imagined_over_simulator: over
    those of ManiSkill with rendering and rule reward, also in one process. Resets are not counted on either side."""
    from wm_nodes.simulation.backend import NoRendererError
    from wm_nodes.simulation.environment import ManiSkillEnvironment

    imagined = make_imagined_environment(config, model, starts, num_envs=IMAGINED_ENVS, seed=config.seed)
    reward = make_endogenous_reward(config, model)
    contenders = [lambda block: rate_episode(imagined, reward, block)]
    missing = ""
    try:
        simulator = ManiSkillEnvironment(config.task, config.simulation, num_envs=SIMULATOR_ENVS, seed=config.seed)
    except NoRendererError as error:
        missing = str(error)
        console.print(f"simulator left out: {error}", highlight=False)
    else:
        rule = RuleReward(config.reward.sparse_weight)
        contenders.append(lambda block: rate_episode(simulator, rule, block))
    console.print("world model against ManiSkill with rendering", highlight=False)
    rates = interleave(contenders, effort.simulator_blocks)
    steps_per_s = [float(np.median([rate.steps_per_s for rate in blocks])) for blocks in rates]
    cores = [float(np.median([rate.cores for rate in blocks])) for blocks in rates]
    details: dict[str, Any] = {
        "imagined_envs": IMAGINED_ENVS, "imagined_cores_used": cores[0], "imagined_goals": imagined.goals() is not None,
        "simulator_envs": SIMULATOR_ENVS, "missing": missing, "reward": reward.name,
    }  # fmt: skip
    if not missing:
        simulator.close()
        details |= {"simulator_steps_per_s": steps_per_s[1], "simulator_cores_used": cores[1]}
    return {
        "imagined_steps_per_s": steps_per_s[0],
        "imagined_over_simulator": None if missing else steps_per_s[0] / steps_per_s[1],
        "simulator": details,
    }


@dataclass(frozen=True)
class Rate:
    """steps_per_s: environment steps that counted. cores: processor time of this process / time."""

    steps_per_s: float
    cores: float


def rate_episode(env: Environment, reward: RewardModel, block: int) -> Rate:
    """Reset, then step with rewards to the step limit; environments that have ended do not count.

    Every goal counts as found: a reward without a goal would be skipped, and look fast.
    """
    observation = env.reset(None, seeds_of(env.spec, block))
    steps = 0
    start, start_cpu = time.perf_counter(), time.process_time()
    for actions in actions_of(env.spec, block, env.spec.max_episode_steps):
        imagined = env.goals()
        goals = None if imagined is None else (imagined[0], np.ones_like(imagined[1]))
        result = env.step(actions)
        reward.evaluate(reward_input(observation, result, goals))
        observation = result.observation
        steps += int(result.valid.sum())
    seconds = time.perf_counter() - start
    return Rate(steps / seconds, (time.process_time() - start_cpu) / seconds)


# Part 4: stages.


def measure_stages(config: RunConfig, effort: Effort, model: Path, starts: Path) -> dict[str, dict[str, float]]:
    """Milliseconds of one batch of 64 and the process's peak memory above its level before, by stage."""
    models = models_of(model)
    tokenizer, action = models.tokenizer, models.action
    rng = numpy_stream(config.seed, "benchmark_stages")
    images, states = (array[rng.integers(0, len(array), IMAGINED_ENVS)] for array in load_starts(starts))
    actions = rng.uniform(-1, 1, (IMAGINED_ENVS, 3)).astype(np.float32)
    zeros = np.zeros(IMAGINED_ENVS, np.float32)
    goals = None if models.text is None else images
    judged = RewardInput(images, images[::-1].copy(), zeros, np.ones(IMAGINED_ENVS, bool), zeros, goals)
    reward, policy = make_endogenous_reward(config, model), make_policy(config, model)
    latents = tokenizer.encode(images)
    caches = action.trunk.new_ring_caches(IMAGINED_ENVS, latents.device)
    row = [torch.from_numpy(array).unsqueeze(1) for array in (actions, states, states)]

    @torch.inference_mode()
    def transition() -> None:
        with compute_context(latents.device):
            prediction = action(latents.unsqueeze(1), *row, caches)
        tokenizer.normalise(latents + prediction.change_BTSD[:, 0])
        done_signal(prediction.done_logits_BTKJ[:, 0])

    for _ in range(config.world_model.window):
        transition()  # a full history is the longest
    stages: dict[str, Callable[[], object]] = {
        "encode": lambda: tokenizer.encode(images),
        "transition": transition,
        "decode": lambda: tokenizer.decode(latents),
        "reward": lambda: reward.evaluate(judged),
        "policy": lambda: policy.act(images, states),
    }
    console.print("stages", highlight=False)
    return {name: measure_stage(work, effort.stage_repeats) for name, work in stages.items()}


def measure_stage(work: Callable[[], object], repeats: int) -> dict[str, float]:
    work()
    before = _restart_peak()
    work()
    peak = _memory_mib("VmHWM")
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return {"ms": 1e3 * float(np.median(seconds)), "peak_mib": peak - before, "process_peak_mib": peak}


def _restart_peak() -> float:
    """Give freed memory back, start the kernel's peak anew, and return the present level, MiB; NaN where it cannot."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (AttributeError, OSError):
        return float("nan")
    return _memory_mib("VmRSS")


def _memory_mib(name: str) -> float:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:")), float("nan"))


# Shared.


def interleave(contenders: Sequence[Callable[[int], T]], blocks: int) -> list[list[T]]:
    """Run A B A B ...; block 0 of each warms up and is dropped."""
    found: list[list[T]] = [[] for _ in contenders]
    for block in range(blocks + 1):
        for results, contender in zip(found, contenders, strict=True):
            results.append(contender(block))
    return [results[1:] for results in found]


def time_episode(env: Environment, block: int) -> NDArray[np.float64]:
    """Seconds of each step of one episode; the reset is not counted."""
    env.reset(None, seeds_of(env.spec, block))
    return _timed(env, actions_of(env.spec, block, env.spec.max_episode_steps))


def time_steps(env: Environment, steps: int) -> NDArray[np.float64]:
    env.reset(None, seeds_of(env.spec, 0))
    return _timed(env, actions_of(env.spec, 0, steps))


def _timed(env: Environment, actions: Iterator[FloatArray]) -> NDArray[np.float64]:
    seconds = []
    for action in actions:
        start = time.perf_counter()
        env.step(action)
        seconds.append(time.perf_counter() - start)
    return np.asarray(seconds)


def actions_of(spec: EnvironmentSpec, block: int, steps: int) -> Iterator[FloatArray]:
    rng = numpy_stream(block, "benchmark_actions")
    for _ in range(steps):
        yield rng.uniform(-1, 1, (spec.num_envs, spec.action_dim)).astype(np.float32)


def seeds_of(spec: EnvironmentSpec, block: int) -> UInt64Array:
    return (block * spec.num_envs + np.arange(spec.num_envs)).astype(np.uint64)


def show(found: dict[str, Any]) -> None:
    """The tables on the screen."""
    graph, simulator, facts = found["graph"], found["simulator"], found["machine"]
    table = Table(title=f"{facts['processor']}, {facts['cores']} cores, {found['date']}", caption=found["model"])
    for name in ("", "value", "goal", "measured"):
        table.add_column(name, justify="right" if name == "value" else "left")
    table.add_row(
        "graph_overhead", f"{found['graph_overhead']:.3f}", "<= 1.10",
        f"{graph['num_envs']} x {graph['image']} step: {graph['dds_step_ms']:.1f} ms over DDS, "
        f"{graph['in_process_step_ms']:.1f} ms in one process",
    )  # fmt: skip
    table.add_row(
        "step_growth", f"{found['step_growth']:.3f}", "about 1",
        f"{graph['growth_steps']} steps, first and last tenth: {graph['growth_first_ms']:.2f} and "
        f"{graph['growth_last_ms']:.2f} ms (10 % quantiles: {graph['growth_first_p10_ms']:.2f} and "
        f"{graph['growth_last_p10_ms']:.2f} ms)",
    )
    ratio = found["imagined_over_simulator"]
    simulated = simulator.get("simulator_steps_per_s")
    table.add_row(
        "imagined_over_simulator", "-" if ratio is None else f"{ratio:.1f}", ">= 10",
        simulator["missing"] if ratio is None else f"ManiSkill with rendering: {simulated:.1f} steps/s",
    )
    table.add_row(
        "imagined_steps_per_s", f"{found['imagined_steps_per_s']:.0f}", ">= 250",
        f"{simulator['imagined_envs']} environments with {simulator['reward']} reward",
    )
    console.print(table)
    stages = Table(title=f"one batch of {IMAGINED_ENVS}")
    for name in ("stage", "ms", "peak memory, MiB"):
        stages.add_column(name, justify="left" if name == "stage" else "right")
    for name, values in found["stages"].items():
        stages.add_row(name, f"{values['ms']:.1f}", f"{values['peak_mib']:.1f}")
    console.print(stages)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark.py", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the numbers there")
    parser.add_argument("--quick", action="store_true", help="a tenth of the work, for a first look; less exact")
    parser.add_argument("--preset", default="cpu", help=f"model size: one of {', '.join(preset_names())}, or a .yaml")
    parser.add_argument("--model-dir", type=Path, help="world model to measure instead of the shipped one")
    parser.add_argument("--seed", type=int, default=0)
    return parser
