"""The velocity network of the embedded flow-matching video model.

Shapes: B batch, C channels, F latent frames, H W latent grid.

Fully convolutional in space and time (factorised 1x3x3 and 3x1x1), so that resolution and length are choices of the
sampler. Each frame is told its own time (0 where it is given clean), the actions up to it, the instruction, and the
last given frame.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wm_nodes.video_model.conditions import Condition

TIME_FEATURES = 32
LEAST_SPREAD = 0.05
"""Of change_std: bounds what a cell that is taken for still amplifies."""


class VelocityModel(Protocol):
    """(x_t, t, condition, drop) -> v = dx/dt of x_t = (1 - t) x_0 + t eps, shape of x_t.

    t: float64 (B,). drop: bool (B,), rows that see neither actions nor instruction (the unconditional branch of
    classifier-free guidance), or (B, 2), rows that do not see the actions, the instruction; None: no row. What is
    returned on conditioning frames is never used.
    """

    def __call__(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor: ...


@dataclass(frozen=True)
class NetworkSettings:
    """Sizes of the network."""

    channels: int
    """Of the latents."""
    action_dim: int
    """Values of an action."""
    text_dim: int = 0
    """Values of an embedded word; 0: no text."""
    width: int = 64
    """Of the hidden layers."""
    depth: int = 5
    """Residual blocks."""
    patch: int = 2
    """Side of the square of latent cells that is embedded together."""
    change_std: float = 0.0
    """Root mean square of a frame's change from the last given one, see _around_last_given; 0: the network's output is
    the velocity itself."""


class VideoNetwork(nn.Module):
    """Residual blocks of factorised convolutions with a per-frame scale and shift (FiLM) from the condition."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        width, patch = settings.width, settings.patch
        self.embed = nn.Conv3d(2 * settings.channels + 3, width, (1, patch, patch), (1, patch, patch))
        self.action = nn.Linear(2 * settings.action_dim + 1, width)
        self.text = nn.Linear(max(1, settings.text_dim), width)
        self.time = nn.Sequential(nn.Linear(TIME_FEATURES, width), nn.SiLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(VideoBlock(width) for _ in range(settings.depth))
        self.norm = nn.GroupNorm(min(8, width), width)
        outputs = settings.channels * (2 if settings.change_std else 1)
        self.head = nn.ConvTranspose3d(width, outputs, (1, patch, patch), (1, patch, patch))
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None = None) -> Tensor:
        """See VelocityModel.

        Raises:
            ValueError: latents, actions or text of another size than the network was built for.
        """
        self._check(x, condition)
        H, W = x.shape[3:]
        pad_h, pad_w = -H % self.settings.patch, -W % self.settings.patch
        seen = torch.cat([x, _last_given(x, condition), _places(x, condition.num_conditioning)], 1)
        inputs = F.pad(seen, (0, pad_w, 0, pad_h))
        hidden = self.embed(inputs)
        film_BFD = self._film(x, t, condition, drop)
        for block in self.blocks:
            hidden = block(hidden, film_BFD)
        out: Tensor = self.head(F.silu(self.norm(hidden)))
        out = out[..., :H, :W].contiguous()
        return _around_last_given(out, x, t, condition, self.settings.change_std) if self.settings.change_std else out

    def condition_parameters(self) -> list[nn.Parameter]:
        """Return the weights of time, actions and instruction: their layers, and each block's scale and shift."""
        inputs = ("action.", "text.", "time.")
        return [p for name, p in self.named_parameters() if name.startswith(inputs) or ".film." in name]

    def _film(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor | None) -> Tensor:
        B, frames, K = x.shape[0], x.shape[2], condition.num_conditioning
        times_BF = t.to(device=x.device, dtype=x.dtype).view(B, 1).expand(B, frames).clone()
        times_BF[:, :K] = 0
        kept = x.new_ones(B, 2) if drop is None else (~drop).to(x.dtype).view(B, -1).expand(B, 2)
        steered = self._steering(x, condition) * kept[:, :1, None]
        film: Tensor = self.time(time_features(times_BF)) + self.action(steered)
        if self.settings.text_dim:
            tokens_B1 = (condition.text != 0).any(2).sum(1, keepdim=True).clamp_min(1)  # padding is zeros
            text = condition.text.to(x.dtype).sum(1) / tokens_B1
            film = film + (self.text(text) * kept[:, 1:]).unsqueeze(1)
        return film

    def _steering(self, x: Tensor, condition: Condition) -> Tensor:
        """The action that led to each frame, their sum so far, and 1, (B, F, 2 A + 1); zeros where they are hidden."""
        actions = F.pad(condition.actions.to(x.dtype), (0, 0, 1, 0))  # the first frame follows no action
        if not actions.shape[2]:
            return actions.new_zeros(*actions.shape[:2], 2 * self.settings.action_dim + 1)
        return torch.cat([actions, actions.cumsum(1) / 4, torch.ones_like(actions[..., :1])], 2)

    def _check(self, x: Tensor, condition: Condition) -> None:
        values = condition.actions.shape[2] or self.settings.action_dim
        given = (x.shape[1], values, condition.actions.shape[1] + 1)
        wanted = (self.settings.channels, self.settings.action_dim, x.shape[2])
        if given != wanted:
            raise ValueError(
                f"this video model takes {wanted[0]} latent channels and {wanted[1]} action values for every frame but "
                f"the first ({wanted[2] - 1} actions for {wanted[2]} frames); got {given[0]} channels, {given[1]} "
                f"values, {given[2] - 1} actions"
            )
        if self.settings.text_dim and condition.text.shape[1:][-1] != self.settings.text_dim:
            raise ValueError(f"text must have {self.settings.text_dim} values, got {condition.text.shape[-1]}")


class VideoBlock(nn.Module):
    """norm, scale and shift, spatial convolution, temporal convolution, residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(min(8, width), width)
        self.film = nn.Linear(width, 2 * width)
        self.space = nn.Conv3d(width, width, (1, 3, 3), padding=(0, 1, 1))
        self.time = nn.Conv3d(width, width, (3, 1, 1), padding=(1, 0, 0))
        nn.init.zeros_(self.time.weight)
        nn.init.zeros_(self.time.bias)  # type: ignore[arg-type]

    def forward(self, hidden: Tensor, film_BFD: Tensor) -> Tensor:
        scale, shift = self.film(F.silu(film_BFD)).transpose(1, 2)[..., None, None].chunk(2, 1)
        inner = F.silu(self.norm(hidden) * (1 + scale) + shift)
        out: Tensor = hidden + self.time(F.silu(self.space(inner)))
        return out


def time_features(times: Tensor) -> Tensor:
    """Sines and cosines of times in [0, 1], (..., TIME_FEATURES)."""
    frequencies = torch.exp(torch.linspace(0.0, 4.0, TIME_FEATURES // 2, dtype=times.dtype, device=times.device))
    angles = times.unsqueeze(-1) * frequencies
    return torch.cat([angles.sin(), angles.cos()], -1)


def _last_given(x: Tensor, condition: Condition) -> Tensor:
    """Return the newest given frame for every frame, beyond the reach of temporal convolutions; zeros without one."""
    if condition.num_conditioning == 0:
        return torch.zeros_like(x)
    return condition.frames[:, :, -1:].to(x.dtype).expand_as(x)


def _around_last_given(out: Tensor, x: Tensor, t: Tensor, condition: Condition, change_std: float) -> Tensor:
    """Return v (B, C, F, H, W) of DD-3d from a network output (B, 2C, F, H, W) that says how each cell changes.

    Its halves give mean m and deviation d of the change r = x_0 - g from the last given frame g, as if r were Gaussian.
    From y = x_t - (1 - t) g = (1 - t) r + t eps the least-squares estimate of eps - r is then
    c (y - (1 - t) m) - m with c = (t - (1 - t) d^2) / ((1 - t)^2 d^2 + t^2), and v = that - g: Karras et al. 2022's
    preconditioning, for flow matching, around a frame, with a deviation for each cell. Where nothing changes (d near 0)
    this is exact, and neither the scene nor the noise needs to pass through the network.
    """
    share = t.to(device=x.device, dtype=torch.float32).view(-1, 1, 1, 1, 1)
    mean, spread = out.float().chunk(2, 1)
    mean, variance = change_std * mean, (change_std * (F.softplus(spread) + LEAST_SPREAD)).square()
    expected = _last_given(x, condition).float() + mean
    gain = (share - (1 - share) * variance) / ((1 - share).square() * variance + share.square())
    return (gain * (x.float() - (1 - share) * expected) - expected).to(out.dtype)


def _places(x: Tensor, num_conditioning: int) -> Tensor:
    """Channels that say where a cell is and whether its frame is given, (B, 3, F, H, W)."""
    B, _, frames, H, W = x.shape
    places = x.new_zeros(B, 3, frames, H, W)
    places[:, 0] = torch.linspace(-1, 1, H, dtype=x.dtype, device=x.device).view(1, 1, H, 1)
    places[:, 1] = torch.linspace(-1, 1, W, dtype=x.dtype, device=x.device).view(1, 1, 1, W)
    places[:, 2, :num_conditioning] = 1
    return places


def guided_velocity(model: VelocityModel, x: Tensor, t: Tensor, condition: Condition, cfg: float) -> Tensor:
    """Return v_u + g (v_c - v_u) (DD-3b), g = cfg; 1 is off and costs one call instead of two."""
    conditional = model(x, t, condition)
    if cfg == 1:
        return conditional
    unconditional = model(x, t, condition, torch.ones(len(x), dtype=torch.bool, device=x.device))
    return unconditional + cfg * (conditional - unconditional)
