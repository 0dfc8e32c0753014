"""Spatio-temporal transformer over frames of tokens (RS-1c), with a temporal key/value cache.

Shapes: B batch, T frames given, W frames remembered, S tokens per frame, D width, N condition tokens per frame,
H heads, E values per head. Order in a block: spatial self-attention (within a frame, bidirectional), temporal
self-attention (one position, causal), cross-attention to the frame's condition tokens, MLP.

Attention is plain matrix products: the fused kernels' backward pass is slow on a CPU.
"""

import torch
from torch import Tensor, nn

ROPE_BASE = 100.0


class TemporalCache:
    """Keys and values of past frames for one block. Subclasses decide where they are kept."""

    def extend(self, keys_BTSHE: Tensor, values_BTSHE: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Add T frames; return the keys, values (B, K, S, H, E) and the mask (B or 1, T, K), True where visible; None
        where everything is."""
        raise NotImplementedError

    def angles(self, num_frames: int, num_values: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Cosine and sine (B or 1, T, 1, 1, E / 2) of the rotary embedding of the next `num_frames` frames."""
        raise NotImplementedError


class GrowingCache(TemporalCache):
    """Differentiable: keeps the tensors themselves. For training through rollouts, and for whole clips at once."""

    def __init__(self, window: int) -> None:
        self._window, self._keys, self._values, self._time = window, list[Tensor](), list[Tensor](), 0

    def angles(self, num_frames: int, num_values: int, device: torch.device) -> tuple[Tensor, Tensor]:
        return _rotary_angles(torch.arange(self._time, self._time + num_frames, device=device).unsqueeze(0), num_values)

    def extend(self, keys_BTSHE: Tensor, values_BTSHE: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        num_new = keys_BTSHE.shape[1]
        self._keys.append(keys_BTSHE)
        self._values.append(values_BTSHE)
        self._time += num_new
        keys, values = torch.cat(self._keys, 1), torch.cat(self._values, 1)
        first = max(0, self._time - num_new - self._window + 1)
        if num_new == 1:  # nothing behind the window was returned, and nothing later is there
            return keys[:, first:], values[:, first:], None
        queries = torch.arange(self._time - num_new, self._time, device=keys.device).unsqueeze(1)
        past = torch.arange(first, self._time, device=keys.device).unsqueeze(0)
        mask = (past <= queries) & (past > queries - self._window)
        return keys[:, first:], values[:, first:], mask.unsqueeze(0)


class RingTimes:
    """Each of B environments' own time, which the ring caches of all blocks share; what a frame needs of it (slots,
    mask, rotary angles) is computed once, not in every block.

    Attention runs over the slots that any environment has filled; those that one has not filled yet weigh exactly 0 and
    come after its own, so that its numbers do not depend on when the others were reset. `fixed`, as on a GPU: it runs
    over all slots and times change in place, without a question to the device, so that a step can be captured as one
    graph. While `peeking`, a frame is seen but its slot is written again by the next one: for trying drafts of a frame
    before the final one.
    """

    def __init__(self, window: int, batch: int, device: torch.device, *, fixed: bool) -> None:
        self.window, self.fixed, self.peeking = window, fixed, False
        self.times_B = torch.zeros(batch, dtype=torch.long, device=device)
        self.rows_B = torch.arange(batch, device=device)
        self._num_filled = 0
        self.forget_frame()

    def forget_frame(self) -> None:
        self.slots_B: Tensor | None = None
        self._mask_B1K: Tensor | None = None
        self._angles: tuple[Tensor, Tensor] | None = None

    def restart(self, mask_B: Tensor) -> None:
        """Forget the history of the environments in `mask_B`."""
        self.forget_frame()
        if self.fixed:
            self.times_B.masked_fill_(mask_B, 0)
            return
        self.times_B = torch.where(mask_B, 0, self.times_B)
        self._num_filled = min(self.window, int(self.times_B.max()))

    def angles(self, num_values: int) -> tuple[Tensor, Tensor]:
        if self._angles is None:
            self._angles = _rotary_angles(self.times_B.unsqueeze(1), num_values)
        return self._angles

    def frame(self) -> tuple[Tensor, int, Tensor | None]:
        """Slots (B,) of the frame, the number of slots to look at, and the mask (B, 1, K), None where all count."""
        visible = self.window if self.fixed else min(self.window, self._num_filled + 1)
        if self.slots_B is None:
            self.slots_B = self.times_B % self.window
            filled = torch.arange(visible, device=self.times_B.device) <= self.times_B.unsqueeze(1)
            self._mask_B1K = filled.unsqueeze(1) if self.fixed or not bool(filled.all()) else None
        return self.slots_B, visible, self._mask_B1K

    def advance(self) -> None:
        """The frame has passed through all blocks."""
        if self.peeking:
            return
        self.forget_frame()
        if self.fixed:
            self.times_B.add_(1)
        else:
            self.times_B = self.times_B + 1
            self._num_filled = min(self.window, self._num_filled + 1)


class RingCache(TemporalCache):
    """Fixed memory of one block for inference, one frame at a time; a frame is kept in slot (its time mod window)."""

    def __init__(self, times: RingTimes) -> None:
        self.times = times
        self._keys: Tensor | None = None
        self._values: Tensor | None = None

    def restart(self, mask_B: Tensor) -> None:
        """Forget the history of the environments in `mask_B`, in all blocks."""
        self.times.restart(mask_B)

    def angles(self, num_frames: int, num_values: int, device: torch.device) -> tuple[Tensor, Tensor]:
        if num_frames != 1:
            raise ValueError(f"a RingCache takes one frame at a time, got {num_frames} frames")
        return self.times.angles(num_values)

    def extend(self, keys_BTSHE: Tensor, values_BTSHE: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        if self._keys is None or self._values is None:
            self._keys = keys_BTSHE.new_zeros(keys_BTSHE.shape[0], self.times.window, *keys_BTSHE.shape[2:])
            self._values = torch.zeros_like(self._keys)
        slots, visible, mask = self.times.frame()
        self._keys[self.times.rows_B, slots] = keys_BTSHE[:, 0]
        self._values[self.times.rows_B, slots] = values_BTSHE[:, 0]
        return self._keys[:, :visible], self._values[:, :visible], mask


class Attention(nn.Module):
    """Projections around one attention; queries from x, keys and values from x (fused) or from `condition_dim`."""

    def __init__(self, width: int, num_heads: int, *, cross: bool = False) -> None:
        super().__init__()
        self.num_heads, self.cross = num_heads, cross
        self.norm = nn.LayerNorm(width)
        self.project = nn.Linear(width, width if cross else 3 * width)
        self.condition = nn.Linear(width, 2 * width) if cross else None
        self.out = nn.Linear(width, width)
        nn.init.normal_(self.out.weight, std=0.5 * width**-0.5)
        nn.init.zeros_(self.out.bias)

    def heads(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:-1], self.num_heads, -1)


class SpatialAttention(Attention):
    def forward(self, x_BTSD: Tensor) -> Tensor:
        batch, frames, tokens, width = x_BTSD.shape
        qkv = self.project(self.norm(x_BTSD)).view(batch * frames, tokens, 3, self.num_heads, -1)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        mixed = attend(q, k, v)
        out: Tensor = self.out(mixed.transpose(1, 2).reshape(batch, frames, tokens, width))
        return out


class TemporalAttention(Attention):
    def forward(self, x_BTSD: Tensor, cache: TemporalCache) -> Tensor:
        qkv = self.project(self.norm(x_BTSD)).unflatten(-1, (3, self.num_heads, -1))
        q_BTSHE, k_BTSHE, v_BTSHE = qkv.unbind(3)
        cos, sin = cache.angles(x_BTSD.shape[1], q_BTSHE.shape[-1], x_BTSD.device)
        q_BTSHE, k_BTSHE = _rotate(q_BTSHE, cos, sin), _rotate(k_BTSHE, cos, sin)
        keys, values, mask = cache.extend(k_BTSHE, v_BTSHE)
        if x_BTSD.shape[1] == 1:
            mixed = _attend_one_frame(q_BTSHE, keys, values, mask)
        else:
            q, k, v = (t.permute(0, 2, 3, 1, 4) for t in (q_BTSHE, keys, values))
            mixed = attend(q, k, v, None if mask is None else mask[:, None, None]).permute(0, 3, 1, 2, 4)
        out: Tensor = self.out(mixed.flatten(3))
        return out


class CrossAttention(Attention):
    """To several condition tokens: with a single one the softmax is 1 and the result the same bias everywhere."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__(width, num_heads, cross=True)

    def forward(self, x_BTSD: Tensor, condition_BTND: Tensor, visible_BN: Tensor | None = None) -> Tensor:
        batch, frames, tokens, width = x_BTSD.shape
        assert self.condition is not None
        q = self.heads(self.project(self.norm(x_BTSD))).flatten(0, 1).transpose(1, 2)
        kv = self.condition(condition_BTND).view(batch * frames, -1, 2, self.num_heads, width // self.num_heads)
        k, v = kv.permute(2, 0, 3, 1, 4).unbind(0)
        mask = None if visible_BN is None else visible_BN.repeat_interleave(frames, 0)[:, None, None]
        out: Tensor = self.out(attend(q, k, v, mask).transpose(1, 2).reshape(batch, frames, tokens, width))
        return out


class SpatioTemporalBlock(nn.Module):
    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.spatial = SpatialAttention(width, num_heads)
        self.temporal = TemporalAttention(width, num_heads)
        self.cross = CrossAttention(width, num_heads)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.SiLU(), nn.Linear(4 * width, width)
        )

    def forward(
        self, x_BTSD: Tensor, condition_BTND: Tensor, cache: TemporalCache, visible_BN: Tensor | None = None
    ) -> Tensor:
        x_BTSD = x_BTSD + self.spatial(x_BTSD)
        x_BTSD = x_BTSD + self.temporal(x_BTSD, cache)
        x_BTSD = x_BTSD + self.cross(x_BTSD, condition_BTND, visible_BN)
        out: Tensor = x_BTSD + self.mlp(x_BTSD)
        return out


class SpatioTemporalTransformer(nn.Module):
    """`depth` blocks and a final norm. There is no absolute time: time enters through rotary differences only."""

    def __init__(self, width: int, depth: int, num_heads: int, window: int) -> None:
        super().__init__()
        if width % num_heads or (width // num_heads) % 2:
            raise ValueError(f"world_model.width {width} must be an even multiple of world_model.num_heads {num_heads}")
        self.window = window
        self.blocks = nn.ModuleList(SpatioTemporalBlock(width, num_heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width)

    def new_caches(self) -> list[TemporalCache]:
        return [GrowingCache(self.window) for _ in self.blocks]

    def new_ring_caches(self, batch: int, device: torch.device, *, fixed: bool | None = None) -> list[RingCache]:
        """Caches of all blocks, which share their times. fixed: see RingTimes; by default on any device but the CPU."""
        times = RingTimes(self.window, batch, device, fixed=device.type != "cpu" if fixed is None else fixed)
        return [RingCache(times) for _ in self.blocks]

    def forward(
        self, x_BTSD: Tensor, condition_BTND: Tensor, caches: list[TemporalCache] | list[RingCache] | None = None,
        visible_BN: Tensor | None = None,
    ) -> Tensor:
        """Features (B, T, S, D). With caches, frames continue where the caches' frames end.

        visible_BN: False where a condition token is padding; None where none is.
        """
        for block, cache in zip(self.blocks, caches or self.new_caches(), strict=True):
            x_BTSD = block(x_BTSD, condition_BTND, cache, visible_BN)
        if caches and isinstance(caches[0], RingCache):
            caches[0].times.advance()
        out: Tensor = self.norm(x_BTSD)
        return out


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q k' / sqrt(E)) v over the last two axes; mask True where a key is visible."""
    scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
    if mask is not None:
        scores = scores.masked_fill(~mask, torch.finfo(scores.dtype).min)
    mixed: Tensor = scores.softmax(-1) @ v
    return mixed


def _attend_one_frame(q_B1SHE: Tensor, keys_BKSHE: Tensor, values_BKSHE: Tensor, mask_B1K: Tensor | None) -> Tensor:
    """Attention of one frame over its past; products and sums, as matrices of one row are slow to multiply."""
    scores_BKSH = ((q_B1SHE * q_B1SHE.shape[-1] ** -0.5) * keys_BKSHE).sum(-1)
    if mask_B1K is not None:
        scores_BKSH = scores_BKSH.masked_fill(~mask_B1K[:, 0, :, None, None], torch.finfo(scores_BKSH.dtype).min)
    mixed: Tensor = (scores_BKSH.softmax(1).unsqueeze(-1) * values_BKSHE).sum(1, keepdim=True)
    return mixed


def _rotary_angles(time_BT: Tensor, num_values: int) -> tuple[Tensor, Tensor]:
    frequencies = ROPE_BASE ** -(torch.arange(0, num_values, 2, device=time_BT.device) / num_values)
    angles = time_BT[:, :, None, None, None].float() * frequencies
    return angles.cos(), angles.sin()


def _rotate(x_BTSHE: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    half = x_BTSHE.shape[-1] // 2
    first, second = x_BTSHE[..., :half], x_BTSHE[..., half:]
    cos, sin = cos.to(x_BTSHE.dtype), sin.to(x_BTSHE.dtype)
    return torch.cat((first * cos - second * sin, second * cos + first * sin), -1)
