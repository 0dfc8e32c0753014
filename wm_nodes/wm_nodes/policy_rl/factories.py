"""Builds what needs more than one sibling package: policies, rewards and environments from a model folder."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import simulation_spec
from wm_nodes.core.types import FloatArray, Observation, UInt8Array
from wm_nodes.policy_rl.image_policy import ImageEncoder, ImagePolicy
from wm_nodes.reward import EncoderDistance, EndogenousReward
from wm_nodes.training.weights import load_weights
from wm_nodes.world_model import ImaginedEnvironment, WorldModels, load_model_folder, load_starts

STATE_DIM, ACTION_DIM = 3, 3


@functools.lru_cache(maxsize=4)
def models_of(model_dir: Path) -> WorldModels:
    """The models of a folder, loaded once per process."""
    return load_model_folder(model_dir)


def make_encoder(model_dir: Path) -> ImageEncoder:
    """The tokenizer as the policy's frozen image encoder: latents flattened to (B, S D)."""
    models = models_of(Path(model_dir))
    tokenizer = models.tokenizer

    def function(images: Tensor) -> Tensor:
        return tokenizer.encode(images).flatten(1).clone()

    return ImageEncoder(function, tokenizer.num_tokens * tokenizer.latent_dim, models.tokenizer_sha256)


def make_policy(config: RunConfig, model_dir: Path) -> ImagePolicy:
    """A policy with fresh weights."""
    return ImagePolicy(make_encoder(model_dir), STATE_DIM, ACTION_DIM, config.policy, seed=config.seed)


def load_policy(config: RunConfig, model_dir: Path, weights: Path) -> ImagePolicy:
    """A policy with weights from a file.

    Raises:
        ValueError: the weights belong to another architecture or to another tokenizer.
    """
    policy = make_policy(config, model_dir)
    metadata = load_weights(policy, Path(weights).read_bytes())
    made_for = metadata.get("tokenizer_sha256", "")
    if made_for and made_for != policy.encoder.sha256:
        raise ValueError(f"{weights} was trained on another tokenizer (sha256 {made_for[:12]}) than {model_dir} holds")
    return policy


def make_reconstruct(model_dir: Path) -> Callable[[UInt8Array], UInt8Array]:
    """Images as the world model shows them: decode(encode(x))."""
    tokenizer = models_of(Path(model_dir)).tokenizer

    def reconstruct(images: UInt8Array) -> UInt8Array:
        return np.concatenate(
            [tokenizer.decode(tokenizer.encode(images[i : i + 256])).numpy() for i in range(0, len(images), 256)]
        )

    return reconstruct


def make_endogenous_reward(config: RunConfig, model_dir: Path) -> EndogenousReward:
    """Reward RS-8 with the distance of the frozen tokenizer's features.

    Raises:
        ValueError: reward.mode progress, whose golden trajectories no environment publishes: env/goal holds one frame.
    """
    if config.reward.mode == "progress" and config.reward.dense_weight:
        raise ValueError(
            "reward.mode progress needs golden trajectories, and environments publish the goal frame only; choose "
            "delta or abs, or set reward.dense_weight to 0 (EndogenousReward itself takes RewardInput.golden)"
        )
    models = models_of(Path(model_dir))

    def features(images: Tensor) -> Tensor:
        return models.tokenizer.encode(images).flatten(1)

    return EndogenousReward(config.reward, EncoderDistance(features, identity=models.tokenizer_sha256[:16]))


def make_imagined_environment(
    config: RunConfig, model_dir: Path, starts_file: Path, *, num_envs: int, seed: int
) -> ImaginedEnvironment:
    """The world model as an environment for config.task.

    Raises:
        ValueError: the folder was trained for another scene than the configuration describes.
    """
    models = models_of(Path(model_dir))
    made_for = models.simulation
    for name in ("cameras", "image_size", "control_hz", "max_action_m", "workspace_low_m", "workspace_high_m"):
        wanted, found = getattr(config.simulation, name), getattr(made_for, name)
        if wanted != found:
            raise ValueError(
                f"{model_dir} was trained with simulation.{name} = {found}, the configuration says {wanted}; change "
                "the configuration or train another model"
            )
    spec = simulation_spec(config.task, config.simulation, num_envs)
    return ImaginedEnvironment(
        models, spec, load_starts(Path(starts_file)), config.reward, num_envs=num_envs, seed=seed,
        with_goals=config.reward.dense_weight > 0,
    )


def policy_actor(
    config: RunConfig, model_dir: Path, weights: Path, noise: float | None = 0.0
) -> Callable[[Observation, int], FloatArray]:
    """act(observation of one slot, episode seed) -> action (A,), for collecting with a policy in a worker process.

    noise: standard deviation of the action noise, normalised units; None: the policy's own, as in training. Its stream
        is (seed, step).
    """
    torch.set_num_threads(1)
    policy = load_policy(config, model_dir, weights)

    def act(observation: Observation, seed: int) -> FloatArray:
        stream = numpy_stream(seed, "exploration", int(observation.episode_step[0]))
        if noise is None:
            own = stream.standard_normal((1, ACTION_DIM)).astype(np.float32)
            sampled: FloatArray = policy.act(observation.image, observation.state, noise=own).actions[0]
            return sampled
        action = policy.act(observation.image, observation.state).actions[0]
        draw = stream.normal(0, noise, action.shape)
        executed: FloatArray = np.clip(action + draw, -1, 1).astype(np.float32)
        return executed

    return act
