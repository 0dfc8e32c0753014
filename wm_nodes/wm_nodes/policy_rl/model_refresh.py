"""Refresh a world model on what the current policy does in the simulator, and keep the better of the two models.

The action model goes on training on all rounds' policy episodes and on scripted ones (replay). Tokenizer, text model
and probe stay as they are, byte for byte: policies are tied to the tokenizer.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from wm_nodes.config.schema import RunConfig, TokenizerConfig, WorldModelConfig
from wm_nodes.config.seed_ranges import HELDOUT_ROUNDS, MODEL_EPISODES, ROUNDS, seed_spans
from wm_nodes.config.tasks import recorded_task
from wm_nodes.core.device import compute_device, explain_memory
from wm_nodes.core.model_folder import MANIFEST
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.statistics import bootstrap_mean, paired_difference
from wm_nodes.environments.collection import CollectionPlan
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.policy_rl.factories import STARTS, policy_actor
from wm_nodes.policy_rl.initial_policy import write_round_starts
from wm_nodes.recording import read_episodes
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.world_model import ActionModel, WorldModels, load_model_folder, save_refreshed_folder
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.positions import judged_things
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.validation.open_loop import episode_errors


@dataclass(frozen=True)
class ModelComparison:
    """Means of the old and the new model over the same held-out episodes."""

    name: str
    """What is compared, with its unit."""
    old: float
    """Mean of the old model."""
    new: float
    """Mean of the new model."""
    low: float
    """Lower end of the 95 % interval of new less old."""
    high: float
    """Upper end of that interval."""
    error: bool
    """Whether less is better."""

    @property
    def better(self) -> bool:
        return self.high < 0 if self.error else self.low > 0

    @property
    def worse(self) -> bool:
        return self.low > 0 if self.error else self.high < 0


@dataclass(frozen=True)
class RefreshDecision:
    """accepted: beyond chance the new model is better in one number at least and worse in none."""

    rows: tuple[ModelComparison, ...]

    @property
    def accepted(self) -> bool:
        return any(row.better for row in self.rows) and not any(row.worse for row in self.rows)

    @property
    def reason(self) -> str:
        """One sentence for people."""
        worse, better = ([row for row in self.rows if getattr(row, name)] for name in ("worse", "better"))
        if not worse and not better:
            return f"no difference beyond chance in {len(self.rows)} numbers"
        return ("worse: " if worse else "better: ") + ", ".join(
            f"{row.name} {row.old:.3f} -> {row.new:.3f} ({row.low:+.3f} to {row.high:+.3f})" for row in worse or better
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        rows = [{**asdict(row), "better": row.better, "worse": row.worse} for row in self.rows]
        return {"accepted": self.accepted, "reason": self.reason, "rows": rows}


def check_refreshable(model_dir: Path) -> None:
    """Raise ValueError for a model that cannot be refreshed: only a continuous action model without a model of states
    can. That one learns from true places and would be compared by places, not by pictures."""
    manifest = read_world_manifest(model_dir)
    kind = manifest["tokenizer"]["kind"]
    if manifest["world_model"]["state_model_iterations"]:
        raise ValueError(f"{model_dir} predicts places by a model of states, which rounds do not refresh; set "
                         "num_rounds to 1")
    if kind != "continuous":
        raise ValueError(
            f"{model_dir} has tokenizer.kind {kind}; rounds refresh continuous models only: set num_rounds to 1, or "
            "take a model made with tokenizer.kind=continuous"
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
    for name, seeds, episodes in (
        ("train", ROUNDS, config.model_refresh.episodes_per_round),
        ("heldout", HELDOUT_ROUNDS, config.model_refresh.heldout_episodes),
    ):
        plan = CollectionPlan(
            recorded_task(config.task), config.simulation, episodes, seeds.take(episodes, number - 1), {},
            make_policy=partial(policy_actor, config, model_dir, weights, None), policy_version=number,
        )
        bags.append(collect_plan(plan, config, folder / name))
    return bags[0], bags[1]


def collect_replay(config: RunConfig, run_dir: Path) -> list[Path]:
    """Scripted simulator episodes of a run, collected once: the replay of every refresh."""
    plan = scripted_plan(config, config.model_refresh.replay_episodes, MODEL_EPISODES)
    return collect_plan(plan, config, run_dir / "bags" / "replay")


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
            "world_model": settings, "tokenizer": TokenizerConfig.model_validate(manifest["tokenizer"]),
        }
    )
    action = copy.deepcopy(models.action)
    assert isinstance(action, ActionModel)
    episodes = _episodes_for(models, bags, config)
    with explain_memory(device):
        action, metrics = train_action_model(
            models.tokenizer, episodes, training, config.seed + number, folder.with_name(f"{folder.name}_training"),
            model=action.requires_grad_(True),
        )
    refreshed = {
        "source_sha256": models.sha256, "round": number, "episodes": len(episodes), "metrics": metrics,
        "training_seeds": seed_spans(episodes.seeds),
        "model_refresh": config.model_refresh.model_dump(),
    }
    story = {"refreshed": [*manifest.get("refreshed", []), refreshed]}
    save_refreshed_folder(folder, model_dir, action, story)
    load_model_folder(folder)
    return folder


def _episodes_for(models: WorldModels, bags: Sequence[Path], config: RunConfig) -> EpisodeArrays:
    """The bags' episodes, labelled for the model's tasks; without ground truth where it learned from none."""
    recorded = (episode for bag in bags for episode in read_episodes(bag))
    if not models.spec.ground_truth_names:
        recorded = (replace(episode, ground_truth=episode.ground_truth[:, :0]) for episode in recorded)
    return stack_episodes(recorded, models.tasks, num_steps=config.simulation.max_episode_steps)


def compare_models(old: WorldModels, new: WorldModels, heldout: EpisodeArrays, config: RunConfig) -> RefreshDecision:
    """Compare both models on a policy's held-out real episodes: positions at the end, cm, where they know any, and
    whether the done signal is right.

    Intervals: of errors by bootstrap over the episodes (stream of config.seed), of the done signal Tango's.
    """
    before, after = (
        episode_errors(
            models.tokenizer, models.action, heldout, config.task, threshold=config.reward.success_threshold,
            probe=models.probe,
        )
        for models in (old, new)
    )
    rows = []
    for name in judged_things(config.task) if heldout.ground_truth.shape[-1] else ():
        old_cm, new_cm = before[f"{name}_cm"], after[f"{name}_cm"]
        _, low, high = bootstrap_mean(new_cm - old_cm, seed=config.seed)
        rows.append(ModelComparison(f"{name} error, cm", float(old_cm.mean()), float(new_cm.mean()), low, high, True))
    right = paired_difference(before["done_right"].tolist(), after["done_right"].tolist())
    old_share, new_share = (float(errors["done_right"].mean()) for errors in (before, after))
    rows.append(ModelComparison("done signal right", old_share, new_share, right.low, right.high, False))
    return RefreshDecision(tuple(rows))


def round_folder(run_dir: Path, number: int) -> Path:
    """Of round `number`, counted from 1, of a run with several."""
    return run_dir / "rounds" / str(number)


def own_episodes(run_dir: Path, number: int) -> list[Path]:
    """Bags of the policies' episodes of all rounds up to `number`, those of the newest policy first."""
    parts = (round_folder(run_dir, k) / "bags" / "train" for k in range(number, 0, -1))
    return [bag for part in parts for bag in sorted(part.glob("shard_*"))]


def round_starts(config: RunConfig, run_dir: Path, number: int, first_frames: Path) -> Path:
    """The starts file of round `number`: with frames of the policy's own episodes where the round before wrote some."""
    own = number > 1 and config.model_refresh.own_starts > 0
    return round_folder(run_dir, number - 1) / STARTS if own else first_frames


@dataclass(frozen=True)
class Round:
    """One of the rounds of a run: what it trains with."""

    number: int
    """From 1."""
    config: RunConfig
    """The run's with this round's share of the updates and its seed."""
    model_dir: Path
    """The world model to train in."""
    starts: Path
    """Frames to imagine from."""
    folder: Path
    """What the round leaves, where there are several."""
    last: bool
    """Whether it is the run's last one."""


def round_of(config: RunConfig, run_dir: Path, number: int, model_dir: Path, first_frames: Path) -> Round:
    """Round `number` of a run, counted from 1. Raises ValueError where a round would make no update."""
    shares = split_updates(config.ppo.updates, config.model_refresh.num_rounds)
    return Round(
        number, round_config(config, number, shares[number - 1]), model_dir,
        round_starts(config, run_dir, number, first_frames), round_folder(run_dir, number), number == len(shares),
    )


def run_rounds(
    config: RunConfig, run_dir: Path, model_dir: Path, first_frames: Path, train: Callable[[Round], bool]
) -> None:
    """Train in rounds, each in the newest model that was taken.

    Args:
        model_dir: of the first round.
        train: trains one round and, unless it is the last, refreshes its model; returns whether that one is taken.

    Raises:
        ValueError: fewer updates than rounds, or a model that cannot be refreshed.
    """
    if config.model_refresh.num_rounds > 1:
        check_refreshable(model_dir)
    for number in range(1, config.model_refresh.num_rounds + 1):
        part = round_of(config, run_dir, number, model_dir, first_frames)
        model_dir = part.folder / "model" if train(part) else model_dir


def split_updates(updates: int, rounds: int) -> list[int]:
    """Equal shares of the policy updates; the first rounds take the remainder.

    Raises:
        ValueError: a round would make none.
    """
    if rounds > 1 and updates < rounds:
        text = f"ppo.updates is {updates}, fewer than {rounds} rounds; raise it, or lower model_refresh.num_rounds"
        raise ValueError(text)
    share, remainder = divmod(updates, rounds)
    return [share + (number < remainder) for number in range(rounds)]


def round_config(config: RunConfig, number: int, updates: int) -> RunConfig:
    """The configuration of a round: its share of the updates, and from round 2 on a seed of its own, because every
    round's policy versions, from which the learner's random streams follow, begin at 1."""
    seed = config.seed if number == 1 else int(numpy_stream(config.seed, "round", number).integers(2**31))
    return config.model_copy(update={"seed": seed, "ppo": config.ppo.model_copy(update={"updates": updates})})


def refresh_round(
    config: RunConfig, model_dir: Path, weights: Path, first_frames: Path, run_dir: Path, number: int, *,
    say: Callable[[str], None] = lambda text: None,
) -> RefreshDecision:
    """Collect with a round's policy, refresh the model on all rounds' episodes and the replay, and compare.

    Writes to the round's folder: bags, model, and the starts of the next round.

    Args:
        model_dir: that the round trained in. weights: of its policy. first_frames: see write_round_starts.
    """
    settings, folder = config.model_refresh, round_folder(run_dir, number)
    say(
        f"collecting {settings.episodes_per_round} + {settings.heldout_episodes} (held out) episodes of the policy in "
        "the simulator"
    )
    _, heldout = collect_round(config, model_dir, weights, folder / "bags", number)
    own = own_episodes(run_dir, number)
    if settings.own_starts:
        write_round_starts(config, first_frames, own, folder / STARTS)
    say(f"refreshing the world model: {settings.refresh_iterations} iterations")
    refreshed = refresh_model(
        config, model_dir, [*collect_replay(config, run_dir), *own], folder / "model", number=number
    )
    old, new = (load_model_folder(path, compute_device(config.device)) for path in (model_dir, refreshed))
    return compare_models(old, new, _episodes_for(old, heldout, config), config)
