"""Whether a device computes what the CPU does: one rollout on both, from the same starts with the same noise."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.speed.device_models import Model, Models, collector
from benchmarks.speed.device_suite import SHIPPED, Plan, Point, Stopwatch
from wm_nodes.config.schema import RewardConfig
from wm_nodes.core.device import CPU
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.factories import make_policy, models_of
from wm_nodes.policy_rl.rollouts import action_noise
from wm_nodes.world_model import DeviceEnvironment, WorldModels, load_starts

FLOAT32, AUTOCAST = "float32", "autocast"
SMALLEST = 1e-12
"""Done signals below it count as that."""
COMPARED = ("latents", "done_logits", "actions")


class Float32Environment(DeviceEnvironment):
    """All of it in float32, codec and starts too."""

    def __init__(
        self, models: WorldModels, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray], reward: RewardConfig,
        **settings: Any,
    ) -> None:
        super().__init__(models, spec, starts, reward, exact=True, **settings)
        codec = models.tokenizer
        self._tokenizer, self._fast = codec, False
        self._start_latents = codec.bottleneck(codec.features(codec.to_pixels(starts[0])))


def agreement_points(plan: Plan, models: Models, device: str) -> Iterator[Point]:
    """Differences of a rollout in the shipped model: in float32 without TF32, and as rollouts are computed, in
    bfloat16 where it is fast; and whether a captured rollout is the eager one, bit for bit.

    Done signals are compared by their logits: a policy with fresh weights is far from success, and its signals are
    near 0. No episode ends. terminated_equal: share of steps whose end, and so whose sparse reward, would be the same
    with the hardest threshold, the median of the CPU's done signals.
    """
    def compare(watch: Stopwatch, precision: str) -> Mapping[str, float]:
        model = models.at(SHIPPED, SHIPPED.shipped_px)
        here, there = (trajectory(model, plan, precision, name) for name in (CPU, device))
        found: dict[str, float] = {}
        for name in COMPARED:
            apart = (here[name] - there[name]).abs()
            found |= {
                f"{name}_largest": apart.max().item(), f"{name}_mean": apart.mean().item(),
                f"{name}_first_largest": apart[0].max().item(),
            }
        threshold = here["done_logits"].median()
        equal = (here["done_logits"] > threshold) == (there["done_logits"] > threshold)
        return found | {"terminated_equal": equal.float().mean().item()}

    def captured(watch: Stopwatch) -> Mapping[str, float]:
        model = models.at(SHIPPED, SHIPPED.shipped_px)
        eager, replayed = (
            collector(model, plan.agreement_envs, captured=way).collect(plan.num_steps, models.seed, 1)
            for way in (False, True)
        )
        pairs = [(getattr(eager, f.name), getattr(replayed, f.name)) for f in fields(eager)]
        tensors = [(a, b) for a, b in pairs if isinstance(a, Tensor)]
        return {"equal_columns": sum(torch.equal(a, b) for a, b in tensors), "columns": len(tensors)}

    for precision in (FLOAT32, AUTOCAST):
        what = {"precision": precision, "envs": plan.agreement_envs}
        yield Point("agreement", what, "largest difference of the latents", partial(compare, precision=precision))
    if plan.captured:
        yield Point("agreement", {"precision": "captured against eager"}, "equal columns", captured)


@torch.no_grad()
def trajectory(model: Model, plan: Plan, precision: str, device: str) -> dict[str, Tensor]:
    """Columns (T, N, ...) on the CPU of a rollout on `device` by a policy with fresh weights."""
    config = model.config.model_copy(update={"device": device})
    spec = configured_spec(config, plan.agreement_envs)
    kind = Float32Environment if precision == FLOAT32 else DeviceEnvironment
    columns: dict[str, list[Tensor]] = {}
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=precision != FLOAT32):
        env = kind(
            models_of(model.folder, config.device), spec, load_starts(model.starts), config.reward,
            num_envs=spec.num_envs, with_goals=False, fixed=True,
        )
        policy = make_policy(config, model.folder)
        env.reset(
            torch.ones(spec.num_envs, dtype=torch.bool).to(env.device),
            (torch.arange(spec.num_envs) % env.num_starts).to(env.device),
        )
        for step in range(plan.num_steps):
            noise = torch.from_numpy(action_noise(config.seed, 1, step, spec.num_envs, spec.action_dim)).to(env.device)
            features = env.encode(config.policy.inputs)
            actions = policy.distribution(features, env.states_NP).executed(noise)
            result = env.step(actions)
            for name, value in zip(COMPARED, (env.encode(), result.signal_N.logit(SMALLEST), actions), strict=True):
                columns.setdefault(name, []).append(value.cpu())
    return {name: torch.stack(values) for name, values in columns.items()}
