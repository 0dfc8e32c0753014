"""The video model behind the Environment interface: the next frame of each environment, from its own last ones.

Shapes: N environments, M starts, R rows of one call, C channels, G frames given at most, K given frames, h w latent
grid, H W 3 image, A action.
"""

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.load import load_video_config
from wm_nodes.config.schema import RewardConfig, VideoEnvironmentConfig
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, FloatArray, UInt8Array
from wm_nodes.video_model.conditions import Condition, hashed_words
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_model.sampling import initial_noise, sample_videos
from wm_nodes.video_model.success_reader import SuccessReader
from wm_nodes.world_model.imagined_episodes import DeviceEpisodes, ImaginedEpisodes, imagined_spec, put_where
from wm_nodes.world_model.parts import in_parallel
from wm_nodes.world_model.precision import compute_context

ROWS = 16
"""Of each call of the models on a CPU, the last one filled up: with one batch size a row has the same bits beside any
others. Fewer rows cost more each, more rows hardly less."""


class VideoEpisodes(DeviceEpisodes):
    """Imagined episodes of a video model, one sampled frame per step. The done signal is that of `reader`; nothing
    estimates its uncertainty, which is 0, and no goals are imagined.

    Args:
        spec, starts, reward: as DeviceEpisodes's; the spec is that of the simulator the model was learned from.
        settings: of the sampler, an ODE.

    Raises:
        ValueError: a model that cannot be stepped, or of another task or robot; starts of another picture size.
    """

    kind = "video model"

    def __init__(
        self, folder: VideoFolder, reader: SuccessReader, spec: EnvironmentSpec, starts: tuple[UInt8Array, FloatArray],
        reward: RewardConfig, settings: VideoEnvironmentConfig, *, num_envs: int,
    ) -> None:
        check_steppable(folder, spec)
        device = folder.device
        super().__init__(imagined_spec(spec, f"video/{spec.task}", folder.sha256, num_envs), starts, reward, device)
        self.folder, self._reader = folder, reader
        self._rows = ROWS if device.type == "cpu" else num_envs
        self._sampler = load_video_config("base").rollout.with_values(
            num_steps=settings.num_steps, shift=settings.shift, micro_batch=self._rows
        )
        self._start_latents = folder.codec.encode(torch.from_numpy(starts[0]).unsqueeze(1)).to(device)
        self.latent_shape = tuple(self._start_latents.shape[1:])
        self._text = hashed_words((spec.instruction,), folder.network.settings.text_dim).to(device)
        self.begin_anew()

    def begin_anew(self) -> None:
        super().begin_anew()
        assert self.folder.lengths is not None  # checked
        num_envs, most = self.spec.num_envs, self.folder.lengths.given
        # newest last; of the oldest, only the newest _num_given are of the present episode
        self._given = self._start_latents[:1].repeat(num_envs, 1, most, 1, 1)
        self._acted = torch.zeros(num_envs, most, self.spec.action_dim, device=self.device)
        self._num_given = np.ones(num_envs, np.int64)

    def _begin(self, begins_N: Tensor) -> None:
        rows = begins_N.nonzero()[:, 0]
        self._given[rows, :, -1:] = self._start_latents[self.starts_N[rows]]
        self._num_given[rows.cpu().numpy()] = 1

    def _predict(
        self, actions_NA: Tensor, moved_NP: Tensor, valid_N: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """noise: (N, C, 1, h, w), the initial noise of the next frames."""
        assert noise is not None
        acted = torch.cat([self._acted[:, 1:], actions_NA.unsqueeze(1)], 1)
        calls = self._calls(valid_N.cpu().numpy())

        def sample(rows: Tensor) -> tuple[Tensor, Tensor, FloatArray]:
            K = int(self._num_given[int(rows[0])])
            frames = self._given[rows, :, -K:]
            condition = Condition(frames, acted[rows, -K:], self._text.expand(len(rows), -1, -1))
            x = torch.cat([torch.zeros_like(frames), noise[rows]], 2)
            none = torch.zeros(len(rows), dtype=torch.int64)  # an ODE has no step noise
            with compute_context(self.device):
                made = sample_videos(self.folder.network, condition, x, none, self._sampler, []).latents[:, :, -1:]
            pictures = self.folder.codec.decode(made).squeeze(1)
            return made, pictures, self._reader.read(pictures)

        frames, signal = self.frames_NHWC.clone(), torch.zeros(len(valid_N), device=self.device)
        latents = self._given[:, :, -1:].clone()
        for rows, (made, pictures, done) in zip(calls, in_parallel(sample, calls), strict=True):
            latents[rows] = made  # rows that fill up a call are written twice, with the same
            frames[rows], signal[rows] = pictures, torch.from_numpy(done).to(self.device)
        self.finite.logical_and_(torch.isfinite(latents).all())
        stepped = valid_N & self.finite
        put_where(stepped, self._given, torch.cat([self._given[:, :, 1:], latents], 2))
        put_where(stepped, self._acted, acted)
        self._num_given += stepped.cpu().numpy()
        np.minimum(self._num_given, self._given.shape[2], out=self._num_given)
        return frames, signal, torch.zeros_like(signal)

    def _calls(self, valid: BoolArray) -> list[Tensor]:
        """The rows of each call of the models: of as many given frames; on a CPU always ROWS of them."""
        calls = list[Tensor]()
        for K in np.unique(self._num_given[valid]):
            rows = np.flatnonzero(valid & (self._num_given == K))
            if self.device.type == "cpu":
                rows = np.concatenate([rows, np.full(-len(rows) % self._rows, rows[0])])
            calls += torch.split(torch.from_numpy(rows).to(self.device), self._rows)  # type: ignore[no-untyped-call]
        return calls


class VideoEnvironment(ImaginedEpisodes):
    """The NumPy face of VideoEpisodes: N imagined environments in lock-step.

    The initial noise of a frame comes from the stream (seed of the reset, `video_step`, step), so an episode is the
    same in any batch; on a CPU bit for bit.
    """

    episodes: VideoEpisodes

    def _noise(self) -> Tensor:
        seeds = [
            stream_seed(int(seed), "video_step", int(step))
            for seed, step in zip(self._seeds, self._steps(), strict=True)
        ]
        return initial_noise(self.episodes.latent_shape, torch.tensor(seeds)).to(self.device)


def check_steppable(folder: VideoFolder, spec: EnvironmentSpec) -> None:
    """Raise ValueError unless the model can be stepped, as the robot and for the task of `spec`."""
    stride, actions, task = folder.clip["stride"], folder.network.settings.action_dim, folder.manifest.get("task")
    if folder.lengths is None or stride != 1:
        raise ValueError(
            f"this video model makes clips of whole episodes, {stride} steps between two frames, and cannot be "
            "stepped; train one with the preset closed_loop"
        )
    if task not in (None, spec.task):
        raise ValueError(f"this video model was trained for the task {task}, not for {spec.task}; train one for it")
    if actions != spec.action_dim:
        raise ValueError(f"this video model takes {actions} action values, the robot {spec.action_dim}; train it anew")
    if spec.measured:
        names = ", ".join(spec.state_names[i] for i in spec.measured)
        raise ValueError(f"a video model does not predict the measured state ({names}); step a world model instead")
