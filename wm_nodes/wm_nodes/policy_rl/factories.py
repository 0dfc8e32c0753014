"""Builds what needs more than one sibling package: policies, rewards, learners and environments, from a model folder or
by the factory that the settings name."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import PolicyInputs, RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import has_simulator
from wm_nodes.core.cameras import CameraModel
from wm_nodes.core.device import CPU, compute_device, explain_memory
from wm_nodes.core.imports import load_factory
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import MODEL_FIELDS, EnvironmentSpec, agree, tool_spec
from wm_nodes.core.types import Environment, FloatArray, Observation, UInt8Array
from wm_nodes.environments.cameras import simulated_cameras
from wm_nodes.environments.registry import configured_spec, make_environment
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy, commanded_range
from wm_nodes.policy_rl.learner import Learner
from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.reward import EncoderDistance, EndogenousReward, RewardModel, RuleReward
from wm_nodes.training.ranks import Ranks
from wm_nodes.training.weights import load_weights_file
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_model.success_reader import SuccessReader, load_success_reader
from wm_nodes.video_model.video_environment import VideoEnvironment, VideoEpisodes, check_steppable
from wm_nodes.world_model import (
    DeviceEnvironment,
    ImaginedEnvironment,
    ImaginedEpisodes,
    WorldModels,
    load_model_folder,
    load_start_instructions,
    load_starts,
)
from wm_nodes.world_model.folder import model_spec, read_world_manifest
from wm_nodes.world_model.precision import compute_context

STARTS = "starts.safetensors"
"""First frames to imagine from, in a model's folder and in a run's."""
UNTRAINED = "wm_nodes.policy_rl.factories:untrained_policy"
GRID = 4
"""Rows and columns of the mean colours that untrained_policy sees."""

_Imagined = TypeVar("_Imagined", ImaginedEnvironment, DeviceEnvironment)


@functools.lru_cache(maxsize=4)
def models_of(model_dir: Path, device: str = CPU) -> WorldModels:
    """Return the models of a folder on the device of that name (core/device.py), loaded once per process."""
    return load_model_folder(model_dir, compute_device(device))


def make_encoder(model_dir: Path, device: str = CPU, inputs: PolicyInputs = "latents") -> ImageEncoder:
    """Return the tokenizer as the policy's frozen image encoder, see Tokenizer.flatten.

    Raises:
        ValueError: positions alone of a model that reads none.
    """
    models = models_of(Path(model_dir), device)
    if inputs == "state":
        return ImageEncoder(lambda images: images.new_zeros((len(images), 0)), 0, models.tokenizer_sha256, inputs)
    tokenizer, count = models.tokenizer, 0 if inputs == "latents" else models.tokenizer.num_positions
    if inputs == "positions" and not count:
        raise ValueError(f"policy.inputs is positions, and the model in {model_dir} reads none; take latents")

    def encode(images: Tensor) -> Tensor:
        latents = tokenizer.encode(images)
        with compute_context(tokenizer.device):
            return tokenizer.flatten(latents, inputs).clone()

    latents = 0 if inputs == "positions" else tokenizer.num_tokens * tokenizer.latent_dim
    return ImageEncoder(encode, latents + count, models.tokenizer_sha256, inputs, count)


def chosen_model(config: RunConfig, folder: str = "") -> Path | None:
    """The world model of a folder, else the shipped one of the task; without a task none: the real environment is
    trained in."""
    return Path(folder) if folder else shipped_model(config.task) if config.task else None


def run_spec(config: RunConfig, model_dir: Path) -> EnvironmentSpec:
    """The environment of a run: of the configured task in its simulator, or where it has none the one that the world
    model was trained with. Raises ModelFolderError: the folder says none."""
    if has_simulator(config.task):
        return configured_spec(with_reader(config, model_dir))
    return model_spec(model_dir, read_world_manifest(model_dir))


def make_policy(config: RunConfig, model_dir: Path | None) -> ImagePolicy:
    """Return a policy with fresh weights: that of policy.factory or policy.checkpoint, else one for run_spec, whose
    measured states are shifted and scaled by what was recorded.

    Raises:
        ValueError: neither a factory nor a checkpoint nor a model; a two-valued action that the spec has not; a state
            that is all commanded, and nothing else to see.
    """
    if config.policy.factory:
        made: ImagePolicy = load_factory(config.policy.factory)(config)
        return made.to(compute_device(config.device))
    if config.policy.checkpoint:
        from wm_nodes.policy_rl import openvla

        return openvla.make_policy(config)
    if model_dir is None:
        raise ValueError(f"a policy sees by a world model's tokenizer; name a model's folder, or policy.factory, e.g. "
                         f"{UNTRAINED}")
    encoder = make_encoder(model_dir, config.device, config.policy.inputs)
    spec = run_spec(config, model_dir)
    check_inputs(config, spec)
    state_range = commanded_range(spec, config.policy)
    if spec.measured:
        recorded = models_of(Path(model_dir), config.device).action.condition
        codes = spec.state_dim - spec.tool_dim
        state_range = recorded.state_mean.tolist() + [0.0] * codes, recorded.state_scale.tolist() + [1.0] * codes
    if unknown := set(config.policy.two_valued_actions) - set(spec.action_names):
        raise ValueError(f"policy.two_valued_actions names {', '.join(sorted(unknown))}; the actions are "
                         f"{', '.join(spec.action_names)}")
    policy = ImagePolicy(
        encoder, spec.state_dim, spec.action_dim, config.policy, seed=config.seed, state_range=state_range,
        two_valued=[spec.action_names.index(name) for name in config.policy.two_valued_actions],
        differences=spec.differences,
        ignored=[i for i, name in enumerate(spec.state_names) if name in config.policy.ignored_state],
    )
    return policy.to(compute_device(config.device))


def check_inputs(config: RunConfig, spec: EnvironmentSpec) -> None:
    """Raise ValueError for a policy of the state alone where that is all commanded, or where a setting of what is seen
    beside it would do nothing."""
    if config.policy.inputs != "state":
        return
    if not spec.measured:
        raise ValueError("policy.inputs is state, and the state says of nothing but the commanded tool where it is; "
                         "take a model with an object reader (preset scenes), or latents")
    for name, value in (
        ("policy.dropout", config.policy.dropout),
        ("imagined_environment.picture_noise", config.imagined_environment.picture_noise),
    ):
        if value:
            raise ValueError(f"{name} is {value:g}, and a policy with policy.inputs state sees no picture; set it to "
                             "0, or take other inputs")


def untrained_policy(config: RunConfig) -> ImagePolicy:
    """Return a policy for configured_spec that sees GRID x GRID mean colours and, before training, acts at random: for
    the first recordings, before there is a model whose tokenizer a policy could see by. A value of policy.factory."""
    spec = configured_spec(config)

    def encode(images: Tensor) -> Tensor:
        return adaptive_avg_pool2d(images.movedim(-1, 1).float() / 255, GRID).flatten(1)

    encoder = ImageEncoder(encode, 3 * GRID * GRID)
    return ImagePolicy(encoder, spec.state_dim, spec.action_dim, config.policy, seed=config.seed)


def make_reward(config: RunConfig, model_dir: Path | None, *, golden: bool = False) -> RewardModel:
    """Return what a step is worth: the reward of reward.factory, else the endogenous one of the world model, or without
    a model the environment's own success.

    Args:
        golden: it is for rollouts that know golden trajectories, see make_collector.

    Raises:
        ValueError: reward.mode progress without golden trajectories: env/goal holds one frame.
    """
    if config.reward.factory:
        reward: RewardModel = load_factory(config.reward.factory)(config)
        return reward
    if model_dir is None:
        return RuleReward(config.reward.sparse_weight)
    if config.reward.needs_golden and not golden:
        raise ValueError(
            "reward.mode progress compares with golden trajectories, and env/goal is one frame; train in one process "
            "(wm reproduce roboscape, wm benchmark trained-in), or choose delta or abs, or set reward.dense_weight to 0"
        )
    return make_endogenous_reward(config, model_dir)


def make_learner(policy: ImagePolicy, config: RunConfig, ranks: Ranks | None = None) -> Learner:
    """Return the algorithm that trains `policy` in place: that of learner.factory, else PPO, to which the present
    weights are the reference that the policy stays close to."""
    if config.learner.factory:
        learner: Learner = load_factory(config.learner.factory)(policy, config)
        return learner
    return PpoLearner(policy, config.ppo, seed=config.seed, ranks=ranks)


def load_policy(config: RunConfig, model_dir: Path | None, weights: Path) -> ImagePolicy:
    """Return the policy of make_policy with weights from a file.

    Raises:
        ValueError: the weights belong to another architecture or to another tokenizer.
    """
    policy = make_policy(config, model_dir)
    metadata = load_weights_file(policy, Path(weights))
    sha256 = metadata.get("tokenizer_sha256", "")
    if sha256 and sha256 != policy.encoder.sha256:
        raise ValueError(f"{weights} was trained on another tokenizer (sha256 {sha256[:12]}) than {model_dir} holds")
    return policy


def make_reconstruct(model_dir: Path, device: str = CPU) -> Callable[[UInt8Array], UInt8Array]:
    """Return the function that gives images as the world model shows them: decode(encode(x))."""
    tokenizer = models_of(Path(model_dir), device).tokenizer

    def reconstruct(images: UInt8Array) -> UInt8Array:
        return np.concatenate(
            [tokenizer.decode(tokenizer.encode(images[i : i + 256])).cpu().numpy() for i in range(0, len(images), 256)]
        )

    return reconstruct


def make_endogenous_reward(config: RunConfig, model_dir: Path) -> EndogenousReward:
    """Return reward RS-8 with the distance of the frozen tokenizer's features."""
    encoder = make_encoder(model_dir, config.device)
    return EndogenousReward(config.reward, EncoderDistance(encoder.function, identity=encoder.sha256[:16]))


def make_imagined_environment(
    config: RunConfig, model_dir: Path, starts_file: Path, *, num_envs: int, seed: int, training: bool = False
) -> ImaginedEnvironment:
    """Return the world model as an environment for config.task.

    Args:
        training: show frames with imagined_environment.picture_noise.

    Raises:
        SpecMismatch: the folder was trained with another environment than the configuration describes.
    """
    settings = config.imagined_environment
    second = models_of(Path(settings.second_model), config.device) if settings.second_model else None
    noise = settings.picture_noise if training else 0.0
    make = partial(ImaginedEnvironment, seed=seed, picture_noise=noise, second=second)
    environment = imagined_by(make, config, model_dir, starts_file, num_envs)
    environment.cameras = _cameras(config, environment)
    return environment


def make_video_environment(
    config: RunConfig, video_model_dir: Path, starts_file: Path, *, num_envs: int, seed: int
) -> VideoEnvironment:
    """Return a video model as an environment for config.task. Raises as load_steppable."""
    folder, reader = load_steppable(config, video_model_dir)
    spec = configured_spec(config, num_envs)
    with explain_memory(folder.device, ppo__num_envs=num_envs):
        episodes = VideoEpisodes(
            folder, reader, spec, load_starts(Path(starts_file), config.task), config.reward, config.video_environment,
            num_envs=num_envs,
        )
    environment = VideoEnvironment(episodes, seed=seed)
    environment.cameras = _cameras(config, environment)
    return environment


def load_steppable(config: RunConfig, video_model_dir: Path) -> tuple[VideoFolder, SuccessReader]:
    """Return a video model that can be stepped for config.task, and its done signal.

    Raises:
        ValueError: a model that cannot be stepped, or settings that ask for what it does not give; names the remedy.
    """
    for name, missing in (("dense_weight", "goals"), ("uncertainty_limit", "uncertainty")):
        if value := getattr(config.reward, name):
            raise ValueError(f"reward.{name} is {value}, and a video model gives no {missing}; set it to 0")
    device = compute_device(config.device)
    folder = load_video_folder(video_model_dir, device)
    check_steppable(folder, configured_spec(config))
    return folder, load_success_reader(video_model_dir, config.task, device)


def make_device_environment(
    config: RunConfig, model_dir: Path, starts_file: Path, *, num_envs: int
) -> DeviceEnvironment:
    """Return the world model as a device program for config.task, for DeviceCollector. Raises as
    make_imagined_environment."""
    return imagined_by(DeviceEnvironment, config, model_dir, starts_file, num_envs)


def _cameras(config: RunConfig, environment: ImaginedEpisodes) -> Sequence[CameraModel]:
    if not has_simulator(config.task):
        return ()
    return simulated_cameras(config.simulation, lambda env: environment.current().state[env])


def imagined_by(
    make: Callable[..., _Imagined], config: RunConfig, model_dir: Path, starts_file: Path, num_envs: int
) -> _Imagined:
    """Return what `make` makes of the arguments of a DeviceEnvironment for config.task. Raises as
    make_imagined_environment."""
    models = models_of(Path(model_dir), config.device)
    spec = replace(run_spec(config, model_dir), num_envs=num_envs)
    check_model(spec, model_dir, models.spec)
    with explain_memory(compute_device(config.device), ppo__num_envs=num_envs):
        return make(
            models, spec, load_starts(Path(starts_file), spec.task), config.reward, num_envs=num_envs,
            instructions=load_start_instructions(Path(starts_file), spec), with_goals=config.reward.dense_weight > 0,
        )


def make_training_environment(
    config: RunConfig, model_dir: Path | None, *, num_envs: int, seed: int
) -> Environment | DeviceEnvironment:
    """Return the environment that policy_rl.train trains in fastest: on a GPU rollouts stay there, unless
    imagined_environment, a factory or policy.checkpoint is set. Without a model it is the real one."""
    settings = config.imagined_environment
    if model_dir is None:
        return make_environment(config, config.environment.factory, num_envs=num_envs, seed=seed)
    starts_file = model_dir / STARTS
    factory = config.policy.foreign or config.reward.factory or config.learner.factory
    if compute_device(config.device).type == CPU or settings.picture_noise or settings.second_model or factory:
        return make_imagined_environment(config, model_dir, starts_file, num_envs=num_envs, seed=seed, training=True)
    return make_device_environment(config, model_dir, starts_file, num_envs=num_envs)


def check_model(spec: EnvironmentSpec, model_dir: Path, trained_with: EnvironmentSpec) -> None:
    """Raise SpecMismatch unless the model of `model_dir`, trained with another spec, knows this environment."""
    remedy = "change simulation.* of the configuration, or train another model (--from-scratch)"
    agree(tool_spec(spec), trained_with, f"{model_dir} was trained with", MODEL_FIELDS, simulated=remedy)


def policy_actor(
    config: RunConfig, model_dir: Path, weights: Path, noise: float | None = 0.0
) -> Callable[[Observation, int], FloatArray]:
    """Return act(observation of one slot, episode seed) -> action (A,), for collecting with a policy in a worker.

    noise: standard deviation of the action noise, normalised units; None: the policy's own, as in training. Its stream
        is (seed, step).
    """
    torch.set_num_threads(1)
    policy = load_policy(config.with_values(device=CPU), model_dir, weights)  # many workers: no GPU context for each

    def act(observation: Observation, seed: int) -> FloatArray:
        stream = numpy_stream(seed, "exploration", int(observation.episode_step[0]))
        own = stream.standard_normal((1, policy.action_dim)).astype(np.float32) if noise is None else None
        action: FloatArray = policy.act(observation.image, observation.state, noise=own).actions[0]
        if noise is not None:
            action = np.clip(action + stream.normal(0, noise, action.shape), -1, 1).astype(np.float32)
        return action

    return act
