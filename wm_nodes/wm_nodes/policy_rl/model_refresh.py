"""Refresh a world model on what the current policy does in the simulator, and keep the better of the two models.

The action model goes on training on all rounds' policy episodes and on scripted ones (replay). Tokenizer, text model
and probe stay as they are, byte for byte: policies are tied to the tokenizer.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from wm_nodes.config.schema import RunConfig, TokenizerConfig, WorldModelConfig
from wm_nodes.config.tasks import get_task, recorded_task
from wm_nodes.core.device import compute_device, explain_memory
from wm_nodes.core.model_folder import MANIFEST
from wm_nodes.environments.maniskill.collection import CollectionPlan
from wm_nodes.environments.record import TRAINING_SEEDS, acceptance_plan, collect_plan, scripted_plan
from wm_nodes.policy_rl.factories import policy_actor
from wm_nodes.recording import read_episodes
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.world_model import ActionModel, WorldModels, load_model_folder, save_refreshed_folder
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.validation.acceptance import model_metrics

ROUND_SEEDS, ROUND_HELDOUT_SEEDS = 800_000, 900_000
SEEDS_PER_ROUND = 5_000
"""Reset seeds of round k start at (k - 1) * SEEDS_PER_ROUND from these; model_refresh.num_rounds is at most 20."""


@dataclass(frozen=True)
class ModelComparison:
    """One number of the old and of the new model; NaN where undefined, which is the worst value there is."""

    episodes: str
    name: str
    old: float
    new: float
    worse: bool


@dataclass(frozen=True)
class RefreshDecision:
    """accepted: the new model is no worse than the old one in any number."""

    rows: tuple[ModelComparison, ...]

    @property
    def accepted(self) -> bool:
        return not any(row.worse for row in self.rows)

    @property
    def reason(self) -> str:
        """One sentence for people."""
        if self.accepted:
            return f"no worse than the old model in {len(self.rows)} numbers on held-out episodes"
        return "worse: " + ", ".join(
            f"{row.name} on {row.episodes} episodes {_text(row.old)} -> {_text(row.new)}"
            for row in self.rows if row.worse
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, NaN as None."""
        rows = [{key: None if value != value else value for key, value in asdict(row).items()} for row in self.rows]
        return {"accepted": self.accepted, "reason": self.reason, "rows": rows}


def check_refreshable(model_dir: Path) -> None:
    """Raise ValueError for a model whose tokens are quantised: only the continuous action model can be refreshed."""
    kind = read_world_manifest(model_dir)["tokenizer"]["kind"]
    if kind != "continuous":
        raise ValueError(
            f"{model_dir} has tokenizer.kind {kind}; rounds refresh continuous models only: use --rounds 1 or a model "
            "made with tokenizer.kind=continuous"
        )


def collect_round(
    config: RunConfig, model_dir: Path, weights: Path, folder: Path, number: int
) -> tuple[list[Path], list[Path]]:
    """Simulator episodes of a policy with its own exploration noise: (bags to train on, bags held out).

    The noise is drawn from the policy's own standard deviation, as in training: what RL will visit next.

    Args:
        folder: of this round; episodes that are there already are kept.
        number: of the round, from 1; also the policy version the bags carry.
    """
    bags = []
    for name, first_seed, episodes in (
        ("train", ROUND_SEEDS, config.model_refresh.episodes_per_round),
        ("heldout", ROUND_HELDOUT_SEEDS, config.model_refresh.heldout_episodes),
    ):
        plan = CollectionPlan(
            recorded_task(config.task), config.simulation, episodes, first_seed + SEEDS_PER_ROUND * (number - 1), {},
            make_policy=partial(policy_actor, config, model_dir, weights, None), policy_version=number,
        )
        bags.append(collect_plan(plan, config, folder / name))
    return bags[0], bags[1]


def collect_replay(config: RunConfig, run_dir: Path) -> tuple[list[Path], list[Path]]:
    """Scripted simulator episodes of a run, collected once: (replay for every refresh, held out as for acceptance)."""
    replay = scripted_plan(config, config.model_refresh.replay_episodes, TRAINING_SEEDS)
    return (
        collect_plan(replay, config, run_dir / "bags" / "replay"),
        collect_plan(acceptance_plan(config), config, run_dir / "bags" / "heldout"),
    )


def refresh_model(config: RunConfig, model_dir: Path, bags: Sequence[Path], folder: Path, *, number: int = 1) -> Path:
    """Go on training the action model of `model_dir` on the bags' episodes; write the new model to `folder`.

    Trained on whole rollouts of simulation.max_episode_steps steps. A finished folder is kept; an interrupted training
    goes on from its checkpoint beside it.

    Raises:
        ValueError: quantised tokens, see check_refreshable.
    """
    check_refreshable(model_dir)
    if (folder / MANIFEST).exists():
        return folder
    device = compute_device(config.device)
    models = load_model_folder(model_dir, device)
    manifest = models.manifest
    settings = WorldModelConfig.model_validate(manifest["world_model"]).model_copy(
        update={
            "num_iterations": config.model_refresh.refresh_iterations,
            "learning_rate": config.model_refresh.learning_rate, "rollout_steps": [config.simulation.max_episode_steps],
        }
    )
    training = config.model_copy(
        update={
            "world_model": settings, "simulation": models.simulation,
            "tokenizer": TokenizerConfig.model_validate(manifest["tokenizer"]),
        }
    )
    action = copy.deepcopy(models.action)
    assert isinstance(action, ActionModel)
    recorded = (episode for bag in bags for episode in read_episodes(bag))
    episodes = stack_episodes(recorded, models.tasks, num_steps=config.simulation.max_episode_steps)
    with explain_memory(device):
        action, metrics = train_action_model(
            models.tokenizer, episodes, training, config.seed + number, folder.with_name(f"{folder.name}_training"),
            model=action.requires_grad_(True),
        )
    refreshed = {
        "source_sha256": models.sha256, "round": number, "episodes": len(episodes), "metrics": metrics,
        "model_refresh": config.model_refresh.model_dump(),
    }
    story = {"refreshed": [*manifest.get("refreshed", []), refreshed]}
    save_refreshed_folder(folder, model_dir, action, story)
    load_model_folder(folder)
    return folder


def compare_models(
    old: WorldModels, new: WorldModels, heldout: Mapping[str, EpisodeArrays], config: RunConfig
) -> RefreshDecision:
    """Compare both models on held-out real episodes, by the name of their kind, in the numbers of model acceptance."""
    rows = []
    for name, episodes in heldout.items():
        numbers = [_numbers(model_metrics(models, episodes, config), config, episodes.num_steps)
                   for models in (old, new)]
        for key, before in numbers[0].items():
            after = numbers[1][key]
            worse = is_worse(before, after, config.model_refresh.tolerance, key.endswith("copying"))
            rows.append(ModelComparison(name, key, before, after, worse))
    return RefreshDecision(tuple(rows))


def is_worse(old: float, new: float, tolerance: float, error: bool) -> bool:
    """Whether `new` is worse than `old`: an error that grew by more than the share `tolerance`, or a rate that fell by
    more than it. NaN (undefined) is worse than every number, and equal to itself."""
    if math.isnan(new):
        return not math.isnan(old)
    if math.isnan(old):
        return False
    return new > old * (1 + tolerance) if error else new < old - tolerance


def _numbers(metrics: Mapping[str, float], config: RunConfig, num_steps: int) -> dict[str, float]:
    label = f"h{num_steps:02d}"
    errors = {"tool error / copying": f"tool_ratio_{label}"}
    if get_task(config.task).moves_object:
        errors["object error / copying"] = f"object_moved_ratio_{label}"
    rates = {f"done {kind}": f"done_{config.task}_{kind}" for kind in ("precision", "recall")}
    return {name: float(metrics.get(key, math.nan)) for name, key in (errors | rates).items()}


def _text(value: float) -> str:
    return "undefined" if math.isnan(value) else f"{value:.3f}"
