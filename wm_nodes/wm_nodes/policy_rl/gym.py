"""The world model as Gymnasium environments, wm_nodes/Imagined-v0; importing this module registers them.

    envs = gymnasium.make_vec("wm_nodes.policy_rl.gym:wm_nodes/Imagined-v0", num_envs=64, model_dir="runs/mine/model")
    env = gymnasium.make("wm_nodes.policy_rl.gym:wm_nodes/Imagined-v0", model_dir="runs/mine/model")

environments/gym.py has the real tasks, ModelObservation shows them as the model does. examples/imagined_*.py train in
this. Shapes: N environments, A action, S state, F latents, P positions, H W 3 image.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import parts_of, task_names
from wm_nodes.core.device import CPU
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.environments.spaces import action_space, observation_space
from wm_nodes.policy_rl.factories import STARTS, make_encoder, make_imagined_environment, make_reward
from wm_nodes.policy_rl.rollouts import reward_input
from wm_nodes.world_model.folder import model_spec, read_world_manifest

ID = "wm_nodes/Imagined-v0"
RENDERED = "rgb_array"
SERVED = (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
LATENTS, POSITIONS = "latents", "positions"
OBSERVATIONS = ("image", "state")
"""Names of what is observed, if nothing else is asked for."""


class Observed:
    """Makes the observations of some names out of a picture and a state. A robot has all of them at run time: latents
    and positions are read off its picture by the model's tokenizer.

    image: uint8 (H, W, 3), cameras side by side. state: float32 (S,), where there is one. latents: float32 (F,), those
    of the picture's encoding. positions: float32 (P,), those of object, tool and goal, or of all ground truth,
    that the tokenizer's probe reads, shifted and scaled to the spread of its training data; privileged where the probe
    learned them from a simulator.

    Args:
        names: of the observations.
        space: of image and state.
        folder: of the world model.
        device: computes, see core/device.py.

    Raises:
        ValueError: a name that the model does not have.
    """

    def __init__(self, names: Sequence[str], space: spaces.Dict, folder: Path, device: str) -> None:
        encoder = make_encoder(folder, device, "both")
        sizes = {LATENTS: encoder.feature_dim - encoder.num_positions, POSITIONS: encoder.num_positions}
        boxes = {**space} | {name: spaces.Box(-np.inf, np.inf, (size,)) for name, size in sizes.items() if size}
        chosen = [name for name in names if name in boxes or name != "state"]
        if isinstance(names, str) or not chosen or not set(chosen) <= set(boxes):
            raise ValueError(f"observations {names!r}: give a tuple of {', '.join(boxes)}, which {folder} has")
        self.space = spaces.Dict({name: boxes[name] for name in chosen})
        self._encoder, self._num_latents = encoder, sizes[LATENTS]

    def __call__(self, image: UInt8Array, state: FloatArray | None) -> dict[str, Any]:
        """Return the observations of images (N, H, W, 3) and states (N, S)."""
        shown: dict[str, Any] = {"image": image, "state": state}
        if self.space.keys() & {LATENTS, POSITIONS}:
            features = self._encoder(torch.from_numpy(image)).cpu().numpy()
            shown |= {LATENTS: features[:, : self._num_latents], POSITIONS: features[:, self._num_latents :]}
        return {name: shown[name] for name in self.space}


class ModelObservation(gymnasium.ObservationWrapper[dict[str, Any], FloatArray, dict[str, Any]]):
    """A single environment that observes image and state, e.g. wm/reach-v0, shown as an imagined one: for the real
    success of what was learned in the model.

    Args:
        observations: see Observed.
        model_dir, task: of the model, as ImaginedVectorEnv's.
    """

    def __init__(
        self, env: gymnasium.Env[dict[str, Any], FloatArray], observations: Sequence[str], model_dir: str | Path = "",
        task: str | None = None,
    ) -> None:
        super().__init__(env)
        if not isinstance(env.observation_space, spaces.Dict):
            raise ValueError(f"{env} observes {env.observation_space}, not a Dict of image and state")
        self._observed = Observed(observations, env.observation_space, _folder(model_dir, task), CPU)
        self.observation_space = self._observed.space

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        state = observation.get("state")
        return _first(self._observed(observation["image"][None], None if state is None else state[None]))


class ImaginedVectorEnv(VectorEnv[dict[str, Any], FloatArray, NDArray[Any]]):
    """N imagined environments in lock-step. Observations by name, each (N, ...), see Observed; actions (N, A) in
    [-1, 1].

    An episode begins at a recorded frame, terminates where the model's done signal says success and is truncated at the
    step limit. Rewards are what `wm train-policy` pays: reward.factory, else the endogenous one. infos: is_success,
    success_probability (the done signal), uncertainty.

    Args:
        model_dir: folder of the world model; empty: the shipped one of `task`.
        task: None: that of the model, where it is a task of ours.
        starts: file of the frames that episodes begin at; empty: the model's.
        observations: names of image, state, latents, positions, see Observed. examples/imagined_ppo.py learns from
            latents in minutes; a convolutional network on pictures, from nothing, did not.
        preset, settings: as load_config takes them, e.g. {"reward.success_threshold": 0.5, "device": "cuda"}.
        autoreset_mode: SAME_STEP: a step that ends an episode shows the first observation of the next one, and infos
            has final_obs and final_info; DISABLED: reset(options={"reset_mask": bool (N,)}) begins anew.

    Raises:
        ValueError, OSError: arguments, settings, files or a model that do not fit; names the remedy.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [RENDERED], "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self, num_envs: int = 1, model_dir: str | Path = "", task: str | None = None, starts: str | Path = "",
        preset: str = "cpu", settings: dict[str, Any] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP, render_mode: str | None = None,
        observations: Sequence[str] = OBSERVATIONS,
    ) -> None:
        if autoreset_mode not in {*SERVED, *(mode.value for mode in SERVED)}:
            raise ValueError(f"autoreset_mode {autoreset_mode!r} is not served; take SameStep or Disabled")
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs must be a whole number >= 1, got {num_envs!r}")
        mode, folder = AutoresetMode(autoreset_mode), _folder(model_dir, task)
        manifest = read_world_manifest(folder)
        if task is None:
            learned = model_spec(folder, manifest).task
            task = learned if learned in task_names() else ""
        config = load_config(preset, {"task": task, **(settings or {})})
        if config.task and not set(parts_of(config.task)) <= set(manifest["tasks"]):
            raise ValueError(f"{folder} knows the tasks {', '.join(manifest['tasks'])}, not {config.task!r}; take one "
                             "of these, or another model_dir")
        self._env = make_imagined_environment(
            config, folder, Path(starts or folder / STARTS), num_envs=num_envs, seed=config.seed, training=True
        )
        self._reward = make_reward(config, folder)
        spec = self._env.spec
        self.metadata = {**self.metadata, "autoreset_mode": mode, "render_fps": 1 / spec.control_period_s}
        self.num_envs, self.render_mode, self._mode = num_envs, render_mode, mode
        self._observed = Observed(observations, observation_space(spec), folder, config.device)
        self.single_observation_space, self.single_action_space = self._observed.space, action_space(spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._waiting = np.ones(num_envs, np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """seed: decides where all episodes from now on begin. options: reset_mask, bool (N,)."""
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        if not isinstance(mask, np.ndarray) or (mask.dtype, mask.shape) != (np.bool_, (self.num_envs,)):
            raise ValueError(f"reset_mask must be a bool array of shape ({self.num_envs},), got {mask!r}")
        self._begin(mask)
        return self._shown(), {}

    def step(
        self, actions: FloatArray
    ) -> tuple[dict[str, Any], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Raises ResetNeeded: an episode has ended. ValueError: actions beyond [-1, 1]; a step without a reward."""
        if self._waiting.any():
            raise gymnasium.error.ResetNeeded(
                f"the episodes of environments {np.flatnonzero(self._waiting).tolist()} have ended; reset them, with "
                'options={"reset_mask": ...}'
            )
        before, goals = self._env.current().image, self._env.goals()
        result = self._env.step(np.asarray(actions, np.float32))
        paid = self._reward.evaluate(reward_input(before, result.observation.image, result, goals))
        if not paid.valid.all():
            raise ValueError(f"reward {self._reward.name} has none for a step: {paid.invalid_reason}; Gymnasium knows "
                             "no step without a reward, choose another in reward.*")
        ended = self._waiting = result.ended
        values = {"is_success": result.success, "success_probability": result.success_probability,
                  "uncertainty": result.uncertainty}
        infos = _of(values, ~ended)
        if self._mode == AutoresetMode.DISABLED:
            infos = _of(values, np.ones_like(ended))
        elif ended.any():
            last, final = self._shown(), np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final[i] = {name: batch[i] for name, batch in last.items()}
            infos |= _of({"final_obs": final, "final_info": _of(values, ended)}, ended)
            self._begin(ended)
        return self._shown(), paid.total.astype(np.float64), result.terminated, result.truncated, infos

    def render(self) -> tuple[UInt8Array, ...] | None:
        return tuple(self._env.current().image) if self.render_mode == RENDERED else None

    def close_extras(self, **kwargs: Any) -> None:
        self._env.close()

    def _begin(self, mask: BoolArray) -> None:
        self._env.reset(mask, self.np_random.integers(2**31, size=self.num_envs).astype(np.uint64))
        self._waiting = self._waiting & ~mask

    def _shown(self) -> dict[str, Any]:
        now = self._env.current()
        return self._observed(now.image, now.state)


class ImaginedEnv(gymnasium.Env[dict[str, Any], FloatArray]):
    """One imagined environment, with the arguments of ImaginedVectorEnv and observations without N."""

    metadata = ImaginedVectorEnv.metadata

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        if "num_envs" in arguments:
            raise ValueError("gymnasium.make makes one environment; for num_envs take gymnasium.make_vec")
        self._envs = ImaginedVectorEnv(1, autoreset_mode=AutoresetMode.DISABLED, render_mode=render_mode, **arguments)
        self.metadata, self.render_mode = self._envs.metadata, render_mode
        self.observation_space, self.action_space = self._envs.single_observation_space, self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """seed: decides where this and the following episodes begin."""
        super().reset(seed=seed)
        shown, _ = self._envs.reset(seed=int(self.np_random.integers(2**31)))
        return _first(shown), {}

    def step(self, action: FloatArray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        shown, rewards, terminated, truncated, infos = self._envs.step(np.asarray(action)[None])
        info = {name: values.item() for name, values in infos.items() if not name.startswith("_")}
        return _first(shown), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> UInt8Array | None:
        rendered = self._envs.render()
        return rendered[0] if rendered else None

    def close(self) -> None:
        self._envs.close()


def _folder(model_dir: str | Path, task: str | None) -> Path:
    """The folder of the model that is named, or shipped for the task."""
    if not (model_dir or task):
        raise ValueError("nothing says which world model imagines; give model_dir, or the task of a shipped one")
    return Path(model_dir) if model_dir else shipped_model(task or "")


def _of(values: dict[str, Any], which: BoolArray) -> dict[str, Any]:
    """Infos of the environments `which`, each value beside the mask _name, as Gymnasium lays them out."""
    return values | {f"_{name}": which.copy() for name in values} if which.any() else {}


def _first(batch: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0] for name, values in batch.items()}


gymnasium.register(
    ID, entry_point=f"{__name__}:ImaginedEnv", vector_entry_point=f"{__name__}:ImaginedVectorEnv",
)
