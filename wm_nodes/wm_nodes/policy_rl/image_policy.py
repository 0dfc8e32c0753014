"""A Gaussian policy and a critic on frozen image features. Shapes: B batch, H W 3 image, F features, S state, A action.

The encoder is frozen, shared with the world model, and not part of the weights: they stay below 1 MB and travel inside
one message.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wm_nodes.config.schema import PolicyConfig, PolicyInputs
from wm_nodes.core.differences import Differences
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.policy_rl.gaussian import DiagonalGaussian

_FEATURE_LIMIT = 5.0
_RELATIVE_STD_FLOOR = 0.1


@dataclass(frozen=True)
class ImageEncoder:
    """A frozen image encoder."""

    function: Callable[[Tensor], Tensor]
    """uint8 (B, H, W, 3) -> float (B, F)."""
    feature_dim: int
    """F, features of an image."""
    sha256: str = ""
    """Of the weights behind it; "" when it has none."""
    inputs: PolicyInputs = "latents"
    """What the features are, where a tokenizer gives them."""
    num_positions: int = 0
    """How many of the last features are positions, which a policy does not project."""

    def __call__(self, images_BHWC: Tensor) -> Tensor:
        with torch.no_grad():
            features_BF = self.function(images_BHWC).float()
        if features_BF.shape != (images_BHWC.shape[0], self.feature_dim):
            raise ValueError(
                f"encoder gave features {tuple(features_BF.shape)} for images {tuple(images_BHWC.shape)}, expected "
                f"({images_BHWC.shape[0]}, {self.feature_dim}); the camera differs from the tokenizer's"
            )
        return features_BF


@dataclass(frozen=True)
class PolicyOutput:
    """What a policy does with B observations."""

    actions: FloatArray
    """float32 (B, A) in [-1, 1], to execute."""
    logprobs: FloatArray
    """float32 (B,), nats."""
    values: FloatArray
    """float32 (B,)."""


def commanded_range(spec: EnvironmentSpec, config: PolicyConfig) -> tuple[Sequence[float], Sequence[float]]:
    """Shift and scale (S,) of a commanded state, by the units of its values and the axes in their names."""
    centers = dict(zip(("_x", "_y", "_z"), config.position_center_m, strict=True))
    scales = {"m": config.position_scale_m, "rad": config.rotation_scale_rad}
    units = list(zip(spec.state_names, spec.state_units, strict=True))
    return (
        [centers.get(name[-2:], 0.0) if unit == "m" else 0.0 for name, unit in units],
        [scales.get(unit, 1.0) for _, unit in units],
    )


class ImagePolicy(nn.Module):
    """Separate actor and critic networks on encoder features and robot state.

    Args:
        encoder: frozen; see ImageEncoder.
        state_dim: S.
        action_dim: A.
        config: sizes and the initial log standard deviation.
        seed: of the initial weights (stream `policy_init`).
        state_range: shift and scale of each value of the state (S,); None: it is taken as it is.
        two_valued: which of the actions are -1 or 1.
        differences: EnvironmentSpec.differences, seen beside the state; none: no differences.
        ignored: which values of the state are not seen.
    """

    actor: nn.Module
    critic: nn.Module

    def __init__(
        self, encoder: ImageEncoder, state_dim: int, action_dim: int, config: PolicyConfig, *, seed: int = 0,
        state_range: tuple[Sequence[float], Sequence[float]] | None = None, two_valued: Sequence[int] = (),
        differences: Sequence[tuple[int, int]] = (), ignored: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.state_dim, self.action_dim, self.config, self.two_valued = state_dim, action_dim, config, two_valued
        self.differences = tuple(pair for pair in differences if not {*pair} & {*ignored})
        self.ignored, seen = ignored, Differences(state_dim, self.differences)
        center, scale = state_range or ((0.0,) * state_dim, (1.0,) * state_dim)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(stream_seed(seed, "policy_init"))
            self.actor = _Network(encoder, seen.dim, action_dim, config, output_gain=0.01)
            self.critic = _Network(encoder, seen.dim, 1, config, output_gain=1.0)
        self.seen = seen
        self.shown_S: Tensor | None
        shown = torch.tensor([value not in ignored for value in range(state_dim)])
        self.register_buffer("shown_S", shown if ignored else None, persistent=False)
        self.log_std_A = nn.Parameter(torch.full((action_dim,), config.init_log_std))
        self.two_valued_A: Tensor | None
        flags = torch.tensor([action in two_valued for action in range(action_dim)])
        self.register_buffer("two_valued_A", flags if two_valued else None, persistent=False)
        self.register_buffer("feature_shift_F", torch.zeros(encoder.feature_dim))
        self.register_buffer("feature_scale_F", torch.ones(encoder.feature_dim))
        self.register_buffer("state_shift_S", torch.tensor(center, dtype=torch.float32))
        self.register_buffer("state_scale_S", torch.tensor(scale, dtype=torch.float32))

    @property
    def device(self) -> torch.device:
        return self.log_std_A.device

    def clone(self) -> "ImagePolicy":
        """Return a copy with its own weights and the same encoder, without gradients: a reference policy."""
        copy = ImagePolicy(
            self.encoder, self.state_dim, self.action_dim, self.config, two_valued=self.two_valued,
            differences=self.differences, ignored=self.ignored,
        )
        copy.to(self.device)
        copy.load_state_dict(self.state_dict())
        return copy.requires_grad_(False)

    def features(self, images: UInt8Array | Tensor, *, batch_size: int = 256) -> Tensor:
        """Return (B, F) features without gradient; compute them once per image and reuse them over the epochs.

        images: uint8 (B, H, W, 3). batch_size: images per encoder call.
        """
        images_BHWC = torch.from_numpy(np.ascontiguousarray(images)) if isinstance(images, np.ndarray) else images
        if images_BHWC.dtype != torch.uint8 or images_BHWC.ndim != 4 or images_BHWC.shape[-1] != 3:
            raise ValueError(f"images must be uint8 (B, H, W, 3), got {images_BHWC.dtype} {tuple(images_BHWC.shape)}")
        if len(images_BHWC) == 0:
            return torch.empty(0, self.encoder.feature_dim, device=self.device)
        starts = range(0, len(images_BHWC), batch_size)
        return torch.cat([self.encoder(images_BHWC[start : start + batch_size].to(self.device)) for start in starts])

    def fit_normaliser(self, features_BF: Tensor) -> None:
        """Set shift and scale of every feature from (B, F) features of real frames, before any training.

        Features of the static background hardly vary: the scale is at least a tenth of the mean one, so that their
        noise is not blown up.
        """
        if features_BF.ndim != 2 or len(features_BF) < 2:
            raise ValueError(f"normalisation needs features of at least 2 frames, got {tuple(features_BF.shape)}")
        if not features_BF.shape[1]:
            return
        std_F = features_BF.std(0, correction=0)
        floor = max(float(std_F.mean()) * _RELATIVE_STD_FLOOR, 1e-6)
        self._buffer("feature_shift_F").copy_(features_BF.mean(0))
        self._buffer("feature_scale_F").copy_(std_F.clamp(min=floor))

    def distribution(self, features_BF: Tensor, states_BS: Tensor) -> DiagonalGaussian:
        """Return the action distribution; the mean is not squashed."""
        mean_BA = self.actor(*self._normalise(features_BF, states_BS))
        return DiagonalGaussian(mean_BA, self.log_std_A, self.two_valued_A)

    def cloning_error(self, features_BF: Tensor, states_BS: Tensor, actions_BA: Tensor) -> Tensor:
        """What behaviour cloning makes small (RS-11): the mean squared error of the mean."""
        return (self.distribution(features_BF, states_BS).mean_BA - actions_BA).square().mean()

    def value(self, features_BF: Tensor, states_BS: Tensor) -> Tensor:
        """Return the critic's values, (B,)."""
        return cast(Tensor, self.critic(*self._normalise(features_BF, states_BS))).squeeze(-1)

    def value_beside(self, distribution: DiagonalGaussian, features_BF: Tensor, states_BS: Tensor) -> Tensor:
        """As value, for a policy whose distribution of the same inputs, once asked for a logprob, has read what its
        critic reads, too."""
        return self.value(features_BF, states_BS)

    @torch.no_grad()
    def act(
        self, images: UInt8Array, states: FloatArray, generator: torch.Generator | None = None, *,
        noise: FloatArray | None = None,
    ) -> PolicyOutput:
        """Choose actions for uint8 (B, H, W, 3) images and float32 (B, S) states.

        Args:
            generator: CPU generator of the action noise; None acts deterministically: clamp(mean).
            noise: standard-normal (B, A) instead of a generator, where every row has its own stream.

        Raises:
            ValueError: wrong shapes or dtypes, or a state that is not finite.
        """
        if states.shape != (len(images), self.state_dim):
            raise ValueError(f"states must be ({len(images)}, {self.state_dim}), got {states.shape}")
        if not np.isfinite(states).all():
            raise ValueError(f"states must be finite, got {states[~np.isfinite(states)][0]}")
        states_BS = torch.from_numpy(np.ascontiguousarray(states, dtype=np.float32)).to(self.device)
        features_BF = self.features(images)
        noise_BA: Tensor | None = None
        if noise is not None:
            noise_BA = torch.from_numpy(np.ascontiguousarray(noise, dtype=np.float32)).to(self.device)
        elif generator is not None:
            noise_BA = torch.randn(len(images), self.action_dim, generator=generator).to(self.device)
        distribution = self.distribution(features_BF, states_BS)
        actions_BA = distribution.executed(noise_BA)
        return PolicyOutput(
            _to_numpy(actions_BA), _to_numpy(distribution.logprob(actions_BA)),
            _to_numpy(self.value_beside(distribution, features_BF, states_BS)),
        )

    def _normalise(self, features_BF: Tensor, states_BS: Tensor) -> tuple[Tensor, Tensor]:
        scaled_BF = (features_BF - self._buffer("feature_shift_F")) / self._buffer("feature_scale_F")
        scaled_BS = (states_BS - self._buffer("state_shift_S")) / self._buffer("state_scale_S")
        if self.shown_S is not None:
            scaled_BS = scaled_BS * self.shown_S
        return scaled_BF.clamp(-_FEATURE_LIMIT, _FEATURE_LIMIT), self.seen(scaled_BS, states_BS)

    def _buffer(self, name: str) -> Tensor:
        return cast(Tensor, getattr(self, name))


class _Network(nn.Module):
    """Latents -> LayerNorm -> projection; with positions and state -> MLP of `depth` hidden layers -> output.

    kept: what the projected latents are multiplied by (B, projection), for dropout; None: nothing.
    """

    kept: Tensor | None = None

    def __init__(
        self, encoder: ImageEncoder, state_dim: int, output_dim: int, config: PolicyConfig, *, output_gain: float
    ) -> None:
        super().__init__()
        self.projected_dim = encoder.feature_dim - encoder.num_positions
        if self.projected_dim:
            self.norm = nn.LayerNorm(self.projected_dim)
            self.projection = _linear(self.projected_dim, config.projection)
        projected = config.projection if self.projected_dim else 0
        sizes = [projected + encoder.num_positions + state_dim, *[config.width] * config.depth]
        self.hidden = nn.ModuleList([_linear(i, o) for i, o in pairwise(sizes)])
        self.output = _linear(config.width, output_dim, gain=output_gain)

    def forward(self, features_BF: Tensor, states_BS: Tensor) -> Tensor:
        latents, positions = features_BF[..., : self.projected_dim], features_BF[..., self.projected_dim :]
        hidden = torch.cat([positions, states_BS], dim=-1)
        if self.projected_dim:
            projected = nn.functional.silu(self.projection(self.norm(latents)))
            projected = projected if self.kept is None else projected * self.kept
            hidden = torch.cat([projected, hidden], dim=-1)
        for layer in self.hidden:
            hidden = nn.functional.silu(layer(hidden))
        return cast(Tensor, self.output(hidden))


def _linear(input_dim: int, output_dim: int, *, gain: float = 2**0.5) -> nn.Linear:
    layer = nn.Linear(input_dim, output_dim)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def _to_numpy(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.float().cpu().numpy()
