"""Everything before RL: simulator episodes in, a world-model folder out. Resumable: finished stages are kept."""

import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import date
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from wm_nodes.config.load import ConfigError
from wm_nodes.config.object_state import with_truth
from wm_nodes.config.scenes import splits
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import HELDOUT, MODEL_EPISODES, WEAK_POLICIES, seed_spans
from wm_nodes.config.tasks import get_task, model_tasks, recorded_task
from wm_nodes.core.device import compute_device, device_label, explain_memory
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import MANIFEST
from wm_nodes.core.seeding import initial_weights
from wm_nodes.core.specs import EnvironmentSpec, tool_spec
from wm_nodes.environments.collection import EXTREME, POLICY_LABEL, SCATTERED, CollectionPlan
from wm_nodes.environments.record import collect_plan, collect_scripted, demonstration_plan
from wm_nodes.policy_rl.factories import STARTS, policy_actor
from wm_nodes.policy_rl.initial_policy import (
    MAX_STARTS,
    MODEL_STARTS,
    episode_starts,
    train_weak_policy,
    write_starts,
)
from wm_nodes.policy_rl.object_reader import train_object_reader
from wm_nodes.recording import read_episodes, read_spec
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.recording.training_data import TrainingData, read_training_data
from wm_nodes.reports.summary import plain
from wm_nodes.world_model import ActionModel, Tokenizer, WorldModels, load_model_folder, save_model_folder
from wm_nodes.world_model.folder import action_model_class
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.sentence_encoder import SentenceEncoder
from wm_nodes.world_model.state_model import state_sizes
from wm_nodes.world_model.text import MAX_WORDS, task_instruction
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.training.decoder import train_decoder
from wm_nodes.world_model.training.dynamics import train_action_model
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes, tokenise_episodes
from wm_nodes.world_model.training.position_probe import train_position_probe
from wm_nodes.world_model.training.state_probe import train_state_probe
from wm_nodes.world_model.training.text import demonstrators, golden_rows, train_text_model
from wm_nodes.world_model.training.token_dynamics import train_token_model
from wm_nodes.world_model.training.tokenizer import train_tokenizer
from wm_nodes.world_model.validation.acceptance import model_metrics
from wm_nodes.world_model.validation.controllability import controllability_metrics
from wm_nodes.world_model.validation.goals import goal_metrics

OWN = "two_valued_actions", "ignored_state"
"""Settings of a weak policy that are those of its task."""
FEW_STEPS = 16
"""Of one iteration of the action model: where recorded episodes are longer, their user hears of parts."""


def load_arrays(bags: Iterable[Path], config: RunConfig, tasks: Sequence[str] = ()) -> EpisodeArrays:
    """Stack every episode of the bags, labelled for `tasks`, or all tasks of the scene."""
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return stack_episodes(episodes, tasks or model_tasks(config.task), num_steps=config.simulation.max_episode_steps)


def make_model(config: RunConfig, run_dir: Path, *, command: str = "") -> Path:
    """Collect, train tokenizer, action model and text model, measure on held-out episodes; returns run_dir/model.

    tokenizer.kind lfq has no text model, so no goals: set reward.dense_weight to 0 there.

    Raises:
        DeviceError: there is no such device, which is found out first, or its memory is too small.
        ModelFolderError, MissingPackageError: world_model.text_encoder cannot be loaded, found out before collecting.
        ConfigError: data.ground_truth is false.
    """
    if not config.data.ground_truth:
        raise ConfigError("data.ground_truth is false, and a world model that collects its own episodes learns from "
                          "it; collect with wm collect and train with wm train-model")
    folder, config = run_dir / "model", with_truth(config)
    if (folder / MANIFEST).exists():
        return folder
    device = compute_device(config.device)
    if config.world_model.text_encoder:
        reader = SentenceEncoder(Path(config.world_model.text_encoder))
        print(f"instructions are read by {reader.folder}, sha256 {reader.sha256[:12]}", file=sys.stderr)
    bags = collect_scripted(config, config.data.num_episodes, MODEL_EPISODES, run_dir / "data" / "train")
    spec = read_spec(next(chain(*bags.values())))
    seen = load_arrays(chain(*bags.values()), config)
    count, after = config.data.num_scattered, config.data.num_episodes
    if count:
        where = run_dir / "data" / SCATTERED
        scattered = collect_scripted(config, count, replace(MODEL_EPISODES, first=after), where, behaviour=SCATTERED)
        seen = EpisodeArrays.concatenate([seen, load_arrays(chain(*scattered.values()), config)])
    with explain_memory(device, tokenizer__batch_size=config.tokenizer.batch_size):
        tokenizer, tokenizer_metrics = train_tokenizer(seen, config, config.seed, run_dir)
    eyes, reader_metrics = None, dict[str, float]()
    if config.world_model.object_reader_iterations:
        eyes, reader_metrics = train_object_reader(seen, spec, config, run_dir)
    if config.data.policy_episodes:
        states = torch.from_numpy(seen.states).flatten(0, 1)
        policy_bags = _collect_policy_bags(config, run_dir, tokenizer, spec, states)
        seen = EpisodeArrays.concatenate([seen, load_arrays(policy_bags, config)])
    probe, probe_metrics = train_position_probe(seen, config, config.seed, run_dir)
    episodes, data = seen, tokenise_episodes(tokenizer, seen)
    if config.tokenizer.probe_iterations:
        tokenizer_metrics["probe"] = train_state_probe(tokenizer, data, config.tokenizer, config.seed, run_dir)["loss"]
    if count:
        episodes = seen.select(np.flatnonzero(np.array(seen.behaviours) != SCATTERED))
        data = tokenise_episodes(tokenizer, episodes)
    del seen  # gigabytes
    text, text_metrics = None, dict[str, float]()
    with explain_memory(device, world_model__batch_size=config.world_model.batch_size):
        action, shown_by, dynamics_metrics = _train_dynamics(tokenizer, data, spec, config, run_dir)
        if isinstance(action, ActionModel):
            golden = episodes.select(np.flatnonzero(np.isin(episodes.behaviours, demonstrators())))
            texts = tuple(get_task(task).instruction for task in model_tasks(config.task))
            text, text_metrics = train_text_model(
                tokenizer, action, golden, tokenise_episodes(tokenizer, golden), texts, config, config.seed, run_dir
            )
    story: dict[str, Any] = {
        "made": _made(command, config),
        "data": {
            "episodes": len(episodes), "policy_episodes": episodes.behaviours.count(POLICY_LABEL),
            "scattered_episodes": len(bags) * count,
            "training_seeds": seed_spans((*episodes.seeds, *range(after, after + count))),
            "behaviours": config.data.behaviours,
            "heldout_seeds": [[HELDOUT.first, HELDOUT.first + config.data.num_heldout - 1]],
        },
        "success_threshold": config.reward.success_threshold,
        "training": {
            "tokenizer": tokenizer_metrics, **dynamics_metrics, "text": text_metrics, "probe": probe_metrics,
            **({"object_reader": reader_metrics} if eyes else {}),
        },
    }
    tasks = model_tasks(config.task)
    models = WorldModels(shown_by, action, text, tasks, tool_spec(spec), {}, probe)
    for name, (scenes, behaviour) in _heldout_sets(config).items():
        where = run_dir / "data" / name
        held = collect_scripted(scenes, config.data.num_heldout, HELDOUT, where, behaviour=behaviour)
        found = {task: heldout_metrics(models, load_arrays(its, config), config, task) for task, its in held.items()}
        story[name] = found if len(found) > 1 else next(iter(found.values()))
    write_starts(
        chain(*bags.values()), folder / STARTS, MODEL_STARTS if len(bags) == 1 else MODEL_STARTS // 2, tasks=tasks,
        frames=config.data.start_frames, seed=config.seed,
    )
    decoder = shown_by.decoder if config.tokenizer.decoder_iterations else None
    save_model_folder(
        folder, tokenizer, action, text, config, spec=spec, tasks=tasks, story=story, probe=probe, decoder=decoder,
        reader=eyes,
    )
    load_model_folder(folder)
    return folder


def read_recordings(bags: Sequence[Path], config: RunConfig, task: str = "") -> tuple[TrainingData, dict[str, Tensor]]:
    """Read what a world model is trained on, and the frames that are imagined from beside it (see episode_starts).

    Args:
        task: that the bags must be of; empty: any.

    Raises:
        BagError: as read_training_data. ValueError: tokenizer.patch_px does not fit the pictures.
    """
    data, episodes = read_training_data(
        bags, num_heldout=config.data.num_heldout, seed=config.seed, task=task, ground_truth=config.data.ground_truth,
        check=lambda spec: Tokenizer(config.tokenizer, spec.height, spec.width, 0),
    )
    undone = [episode for episode in episodes if not episode.success[0]]
    return data, episode_starts(undone[:MAX_STARTS], frames=config.data.start_frames, seed=config.seed)


def model_from_data(
    data: TrainingData, starts: dict[str, Tensor], config: RunConfig, folder: Path, *, command: str = "",
    say: Callable[[str], object] = lambda text: None,
) -> Path:
    """Train tokenizer and action model on the recorded episodes of one environment, whichever it is, and measure them
    on those held out; returns the folder, with first frames to imagine from. Checkpoints and metrics lie beside it.

    Success is the task's rule, or without a task file the recorded flag. A text model, for goals, is trained where
    instructions differ, or reward.dense_weight is not 0; it learns from the recordings that succeed.

    Args:
        starts: the first frames, as read_recordings gives them.
        say: gets a line for each stage.
    """
    device, run_dir = compute_device(config.device), folder.parent
    spec = data.spec
    for line in data.summary:
        say(line)
    has_goals = _has_goals(data, config, say)
    say(f"tokenizer, {config.tokenizer.num_iterations} iterations")
    with explain_memory(device, tokenizer__batch_size=config.tokenizer.batch_size):
        tokenizer, tokenizer_metrics = train_tokenizer(data.training, config, config.seed, run_dir)
    probe: PositionProbe | None = None
    if spec.ground_truth_names:
        probe, _ = train_position_probe(data.training, config, config.seed, run_dir)
    if not config.world_model.part_steps and (steps := data.training.num_steps) > FEW_STEPS:
        say(f"every iteration rolls {steps} steps out; --world_model.part_steps {FEW_STEPS} takes random ones, faster")
    say(f"action model with {config.world_model.num_done_heads} done heads, {config.world_model.num_iterations} "
        "iterations")
    with explain_memory(device, world_model__batch_size=config.world_model.batch_size):
        latents = tokenise_episodes(tokenizer, data.training)
        action, shown_by, dynamics_metrics = _train_dynamics(tokenizer, latents, spec, config, run_dir)
        text, text_metrics = None, dict[str, float]()
        if has_goals and isinstance(action, ActionModel):
            say(f"text model, {config.world_model.text_num_iterations} iterations")
            text, text_metrics = train_text_model(
                tokenizer, action, data.training, latents, [task_instruction(task, spec) for task in data.tasks],
                config, config.seed, run_dir,
            )
    say(f"rollouts of {len(data.heldout)} held-out episodes or parts of them")
    models = WorldModels(shown_by, action, text, data.tasks, tool_spec(spec), {}, probe)
    goals = goal_metrics(models, data.heldout, config, data.tasks[0])
    story = {
        "made": _made(command, config),
        "data": {"episodes": data.num_episodes, "summary": list(data.summary)},
        "success_threshold": config.reward.success_threshold,
        "training": {"tokenizer": tokenizer_metrics, **dynamics_metrics, "text": text_metrics},
        "heldout": plain(model_metrics(models, data.heldout, config) | goals),
    }
    write_atomic(folder / STARTS, save(starts))
    return save_model_folder(
        folder, tokenizer, action, text, config, spec=spec, tasks=data.tasks, story=story, probe=probe,
        decoder=shown_by.decoder if shown_by is not tokenizer else None,
    )


def _has_goals(data: TrainingData, config: RunConfig, say: Callable[[str], object]) -> bool:
    """Whether a text model is trained: where instructions differ, or the reward asks for goals.

    Raises:
        ConfigError: the reward asks for goals, and the recordings cannot show them.
    """
    texts, is_asked_for = {*data.training.instructions}, config.reward.dense_weight > 0
    if config.tokenizer.kind == "lfq" or not (is_asked_for or len(texts) > 1):
        return False
    wrong = [text for text in texts if not 0 < len(text.split()) <= MAX_WORDS]
    if wrong and not config.world_model.text_encoder:
        reason = (f"instruction {wrong[0]!r} has {len(wrong[0].split())} words, and 1 to {MAX_WORDS} are read; change "
                  "it, or name a sentence encoder with world_model.text_encoder")
    elif not len(golden_rows(data.training)):
        reason = "no episode that is trained on succeeds after its first frame; record more successes"
    else:
        return True
    if is_asked_for:
        raise ConfigError(f"reward.dense_weight {config.reward.dense_weight:g} asks for imagined goals, but {reason}")
    say(f"no imagined goals: {reason}")
    return False


def _train_dynamics(
    tokenizer: Tokenizer, data: LatentEpisodes, spec: EnvironmentSpec, config: RunConfig, run_dir: Path
) -> tuple[ActionModel | TokenActionModel, Tokenizer, dict[str, dict[str, float]]]:
    """Train the action model that goes with the tokenizer, and where asked for a decoder of its rollouts; returns it,
    the tokenizer that shows what it imagines, and the metrics of both."""
    if config.tokenizer.kind == "lfq":
        tokens, found = train_token_model(tokenizer, data, config, config.seed, run_dir, spec=spec)
        return tokens, tokenizer, {"decoder": {}, "action": found}
    action, found = train_action_model(tokenizer, data, config, config.seed, run_dir, spec=spec)
    shown_by, decoder_metrics = tokenizer, dict[str, float]()
    if config.tokenizer.decoder_iterations:
        shown_by, decoder_metrics = train_decoder(tokenizer, action, data, config, config.seed, run_dir)
    return action, shown_by, {"decoder": decoder_metrics, "action": found}


def _made(command: str, config: RunConfig) -> dict[str, Any]:
    """How, when and where a model was made, for its manifest."""
    return {
        "command": command, "date": date.today().isoformat(), "seed": config.seed, "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        "device": device_label(compute_device(config.device)),
    }


def heldout_metrics(models: WorldModels, episodes: EpisodeArrays, config: RunConfig, task: str) -> dict[str, Any]:
    """Metrics of rollouts of the recorded actions, of other actions, and of goals, over held-out episodes of a task."""
    metrics: dict[str, Any] = plain(
        model_metrics(models, episodes, config) | controllability_metrics(models, episodes, models.spec)
        | goal_metrics(models, episodes, config, task)
    )
    return metrics


def _heldout_sets(config: RunConfig) -> dict[str, tuple[RunConfig, str]]:
    """Configuration and only behaviour, "" for the configured ones, of held-out episodes by folder: of the scenes
    trained on, of the same under extreme actions, and of the other splits."""
    others = set(splits()) - {config.simulation.scenes} if config.simulation.scenes in splits() else set[str]()
    sets = {"heldout": (config, ""), f"heldout_{EXTREME}": (config, EXTREME)}
    return sets | {
        f"heldout_{name}": (config.with_values(simulation=config.simulation.with_values(scenes=name)), "")
        for name in sorted(others)
    }


def _collect_policy_bags(
    config: RunConfig, run_dir: Path, tokenizer: Tokenizer, spec: EnvironmentSpec, states_FP: Tensor
) -> list[Path]:
    """Collect simulator episodes of a few policies cloned from a few demonstrations, acting with exploration noise.

    They need the tokenizer and the range of the states (F, P) only, so they are collected before the action model is
    trained and belong to its data.
    """
    bags = list[Path]()
    weak = [(policy, task) for task in model_tasks(config.task) for policy in get_task(task).model.weak_policies]
    for policy, task in sorted(weak, key=lambda pair: pair[0].number):
        number, sft = policy.number, config.sft.model_copy(update={"num_demonstrations": policy.demonstrations})
        own = {name: tuple(get_task(task).settings.get(f"policy.{name}", ())) for name in OWN}
        chosen = config.with_values(task=task, sft=sft, policy=config.policy.with_values(**own))
        folder = _make_tokenizer_folder(config, run_dir, tokenizer, spec, states_FP)
        weights = run_dir / "policies" / f"weak_{number}.safetensors"
        if not weights.exists():
            plan = demonstration_plan(chosen, *policy.plan)
            train_weak_policy(chosen, folder, collect_plan(plan, config, run_dir / "data" / "demos"), weights)
        plan = CollectionPlan(
            recorded_task(task), config.simulation, config.data.policy_episodes,
            WEAK_POLICIES.take(config.data.policy_episodes, number), {},
            make_policy=partial(policy_actor, chosen, folder, weights, policy.noise),
        )
        bags += collect_plan(plan, config, run_dir / "data" / "policy")
    return bags


def _make_tokenizer_folder(
    config: RunConfig, run_dir: Path, tokenizer: Tokenizer, spec: EnvironmentSpec, states_FP: Tensor
) -> Path:
    """Make a model folder for policies, which read the tokenizer and the range of the states alone: its action model is
    untrained."""
    folder = run_dir / "tokenizer_only"
    if not (folder / MANIFEST).exists():
        tasks = model_tasks(config.task)
        with initial_weights(config.seed, "action_model_init"):
            untrained = action_model_class(config.tokenizer.kind)(
                config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
                action_dim=spec.action_dim, state_dim=spec.tool_dim, num_tasks=len(tasks),
                num_positions=tokenizer.num_positions, **state_sizes(spec),
            )
        untrained.condition.fit_states(states_FP)
        save_model_folder(folder, tokenizer, untrained, None, config, spec=spec, tasks=tasks, story={})
    return folder
