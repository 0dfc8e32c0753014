"""Training rollouts of the frame models in few kernels, for a GPU. The CPU rolls out by training/dynamics.py.

The same function and gradients as calling the model step by step, to rounding, and the same parameters; but whatever
does not depend on the step before is computed once for all T steps and all blocks:
- scale and shift of every norm, and the rotary angles of every step, become part of the linear layer that follows;
- a step's backward pass takes gradients of inputs only; those of a layer's weights are one product over all steps;
- keys and values of the past stay where they were written, and their gradients are summed in place;
- the condition's keys and values, the done heads and the position head see all steps together.
Cost: the rotated weights take T times the memory of the temporal layers' weights, and the outputs' gradients of every
layer are kept until the end of the backward pass.

Products and attention run in the type `dtype`; the sums of the residual stream and its gradients stay float32.
Shapes: B episodes, T steps, S tokens and one register per frame, R = B (S + 1) rows, L values per token, D width,
H heads, E values per head, N condition tokens, G layers of one kind, K past frames.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.world_model.dynamics import FrameModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.transformer import ROPE_BASE, SpatioTemporalBlock

MOST_ROWS = 65535
"""CUDA's attention kernels refuse a larger batch."""


def roll_out_on_device(
    model: FrameModel, tokenizer: Tokenizer, real_BTSL: Tensor, anchors_BT: Tensor, condition_BTND: Tensor,
    dtype: torch.dtype, visible_BN: Tensor | None = None, told_BTKJ: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return next_latents, positions and done_logits of frames 1..T, as training.dynamics.RolloutTerms.

    Args:
        real_BTSL: normalised latents of the recorded frames.
        anchors_BT: True where the model goes on from the recorded frame; the first frame always is one.
        visible_BN: False where a condition token is padding; None where none is.
        told_BTKJ: what DoneHeads is told of frames 1..T.
    """
    batch, steps = condition_BTND.shape[:2]
    given = F.pad(real_BTSL, (0, 0, 0, 1))  # the register's row; the model adds its own value to these zeros
    taken = F.pad(anchors_BT[:, :, None, None].expand(*real_BTSL.shape[:3], 1), (0, 0, 0, 1), value=True)
    with torch.autocast(given.device.type, enabled=False):
        network = _Network(model, batch, given.shape[2], steps, condition_BTND, visible_BN, dtype)
        frames, features = list[Tensor](), list[Tensor]()
        current = given[:, 0]
        for t in range(steps):
            if t:
                current = torch.where(taken[:, t], given[:, t], frames[-1])
            change, normal = network.step(t, current)
            frames.append(tokenizer.normalise(current + change))
            features.append(normal)
        normal_BTSD = torch.stack(features, 1)
        norm = model.trunk.norm
        features_BTSD = normal_BTSD * norm.weight + norm.bias
    logits, positions = model.done(features_BTSD[:, :, :-1], features_BTSD[:, :, -1], told_BTKJ)
    return torch.stack(frames, 1)[:, :, :-1], positions, logits


class _Network:
    """A model's layers made ready for one iteration."""

    def __init__(
        self, model: FrameModel, batch: int, tokens: int, steps: int, condition_BTND: Tensor,
        visible_BN: Tensor | None, dtype: torch.dtype,
    ) -> None:
        blocks: list[SpatioTemporalBlock] = list(model.trunk.blocks)  # type: ignore[arg-type]
        spatial, temporal = [block.spatial for block in blocks], [block.temporal for block in blocks]
        cross = [block.cross for block in blocks]
        norms, wide, _, narrow = (list(parts) for parts in zip(*(block.mlp for block in blocks), strict=True))
        heads, width = spatial[0].num_heads, model.embed.out_features
        self.shape, self.dtype = (batch, tokens, heads, width // heads), dtype
        bias = torch.cat((model.position + model.embed.bias, model.register)).repeat(batch, 1)
        self.embed = _Layers(model.embed.weight.t().unsqueeze(0), bias.unsqueeze(0), torch.float32)
        self.spatial_in = _Layers(*_after_norm([a.norm for a in spatial], [a.project for a in spatial]), dtype)
        self.spatial_out = _Layers(*_plain([a.out for a in spatial]), dtype)
        rotated = _rotated(*_after_norm([a.norm for a in temporal], [a.project for a in temporal]), steps, heads)
        self.temporal_in = _Layers(*rotated, dtype)
        self.temporal_out = _Layers(*_plain([a.out for a in temporal]), dtype)
        self.cross_in = _Layers(*_after_norm([a.norm for a in cross], [a.project for a in cross]), dtype)
        self.cross_out = _Layers(*_plain([a.out for a in cross]), dtype)
        self.mlp_in = _Layers(*_after_norm(norms, wide), dtype)
        self.mlp_out = _Layers(*_plain(narrow), dtype)
        self.change = _Layers(*_after_norm([model.trunk.norm], [model.change]), dtype)
        conditions = [a.condition for a in cross if a.condition is not None]
        self.conditions = _condition_heads(condition_BTND.to(dtype), *_plain(conditions), heads)
        self.visible = None if visible_BN is None else visible_BN[:, None, None]
        shape = (steps, batch * tokens, 3, heads, width // heads)
        self.mapped: Tensor | None = None
        if model.condition_map is not None:
            self.mapped = F.pad(model.condition_map(condition_BTND), (0, 0, 0, 1))  # the register's row has none
        self.pasts = [_Past(condition_BTND.new_empty(shape, dtype=dtype), model.trunk.window) for _ in blocks]
        self.steps = steps

    def step(self, t: int, current_BSL: Tensor) -> tuple[Tensor, Tensor]:
        """Return of all rows the change (B, S + 1, L) and the features (B, S + 1, D) before the last norm's scale."""
        x = self.embed(current_BSL.flatten(0, 1), 0, t)
        if self.mapped is not None:
            x = x + self.mapped[:, t].flatten(0, 1)
        for i in range(len(self.pasts)):
            x, normal = self._normalise(x)
            x = x + self.spatial_out(self._mix_tokens(self.spatial_in(normal, i, t)), i, t)
            x, normal = self._normalise(x)
            qkv = self.temporal_in(normal, i * self.steps + t, t, out=self.pasts[i].slot(t))
            q, keys, values = _Remember.apply(qkv, self.pasts[i], t)  # type: ignore[no-untyped-call]
            x = x + self.temporal_out(_attend(q, keys, values).flatten(1), i, t)
            x, normal = self._normalise(x)
            q = self.cross_in(normal, i, t).view(self.shape).transpose(1, 2)
            mixed = F.scaled_dot_product_attention(q, *self.conditions[i * self.steps + t], attn_mask=self.visible)
            x = x + self.cross_out(mixed.transpose(1, 2).reshape(x.shape), i, t)
            x, normal = self._normalise(x)
            x = x + self.mlp_out(F.silu(self.mlp_in(normal, i, t)), i, t)
        _, normal = self._normalise(x)
        return self.change(normal, 0, t).view(current_BSL.shape), normal.view(*current_BSL.shape[:2], -1)

    def _normalise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return _Normalise.apply(x, self.dtype)  # type: ignore[no-untyped-call, no-any-return]

    def _mix_tokens(self, qkv: Tensor) -> Tensor:
        batch, tokens, heads, values = self.shape
        q, k, v = (part.transpose(1, 2) for part in qkv.view(batch, tokens, 3, heads, values).unbind(2))
        return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(len(qkv), -1)


class _Layers:
    """G linear layers of one kind, each used in several steps: matrices (G, in, out), biases (G, out) or (G, R, out).

    The same layer may not be used twice in one step.
    """

    def __init__(self, matrices: Tensor, biases: Tensor, dtype: torch.dtype) -> None:
        self._uses: _Uses = {}
        parts = _GradientAtTheEnd.apply(self._uses, matrices.to(dtype), biases.to(dtype))  # type: ignore[no-untyped-call]
        self._matrices, self._biases = parts[: len(matrices)], parts[len(matrices) :]

    def __call__(self, rows: Tensor, layer: int, step: int, out: Tensor | None = None) -> Tensor:
        matrix, bias = self._matrices[layer], self._biases[layer]
        result: Tensor = _Product.apply(rows, matrix, bias, self._uses, (layer, step), out)  # type: ignore[no-untyped-call]
        return result


_Uses = dict[tuple[int, int], tuple[Tensor, Tensor]]
"""(layer, step) -> its input and its output's gradient; filled by the backward pass."""


class _GradientAtTheEnd(torch.autograd.Function):
    """Takes layers apart. Its backward pass runs after those of all uses, which return no gradient for the weights."""

    @staticmethod
    def forward(ctx: Any, uses: _Uses, matrices: Tensor, biases: Tensor) -> tuple[Tensor, ...]:
        ctx.uses, ctx.shape = uses, biases.shape
        ctx.set_materialize_grads(False)
        return *matrices.detach().unbind(0), *biases.detach().unbind(0)

    @staticmethod
    def backward(ctx: Any, *nothing: None) -> tuple[None, Tensor, Tensor]:
        used = [ctx.uses[key] for key in sorted(ctx.uses)]
        ctx.uses.clear()
        layers, *bias = ctx.shape
        inputs, gradients = (torch.cat(tensors) for tensors in zip(*used, strict=True))
        matrices = inputs.view(layers, -1, inputs.shape[-1]).transpose(1, 2) @ gradients.view(layers, -1, bias[-1])
        return None, matrices, gradients.view(layers, -1, *bias).sum(1)


class _Product(torch.autograd.Function):
    """bias + rows @ matrix, into `out` where given."""

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, matrix: Tensor, bias: Tensor, uses: _Uses, key: tuple[int, int], out: Tensor | None
    ) -> Tensor:
        ctx.save_for_backward(rows, matrix)
        ctx.uses, ctx.key = uses, key
        return torch.addmm(bias, rows, matrix) if out is None else torch.addmm(bias, rows, matrix, out=out)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, matrix = ctx.saved_tensors
        ctx.uses[ctx.key] = rows.detach(), gradient
        return (gradient @ matrix.t() if ctx.needs_input_grad[0] else None), None, None, None, None, None


class _Normalise(torch.autograd.Function):
    """x itself and x normalised (no scale, no shift) in `dtype`; their gradients meet here in one sum."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        low = x.to(dtype)
        normal, mean, scale = torch.native_layer_norm(low, low.shape[-1:], None, None, 1e-5)
        ctx.save_for_backward(low, mean, scale)
        ctx.set_materialize_grads(False)
        return x.view_as(x), normal

    @staticmethod
    def backward(ctx: Any, of_x: Tensor | None, of_normal: Tensor) -> tuple[Tensor, None]:
        low, mean, scale = ctx.saved_tensors
        gradient = torch.ops.aten.native_layer_norm_backward(
            of_normal, low, low.shape[-1:], mean, scale, None, None, [True, False, False]
        )[0]
        return gradient.float() if of_x is None else of_x + gradient, None


class _Past:
    """Queries, keys and values (T, R, 3, H, E) of one block, where its products write them, and their gradients."""

    def __init__(self, qkv: Tensor, window: int) -> None:
        self._qkv, self._window = qkv, window
        self._gradients: Tensor | None = None
        self._next = -1

    def slot(self, t: int) -> Tensor:
        """Row (R, 3 D) of step t. `data`: later steps write elsewhere, which autograd would take for a change."""
        return self._qkv.data[t].flatten(1)

    def seen(self, qkv: Tensor, t: int) -> Tensor:
        """Frames (3, R, H, K, E) that step t may see."""
        return qkv.data[max(0, t - self._window + 1) : t + 1].permute(2, 1, 3, 0, 4)

    def add_gradients(self, t: int, of_q: Tensor, of_keys: Tensor, of_values: Tensor) -> Tensor:
        """Return the gradient (R, 3 D) of step t's row; those of all later steps must have been added."""
        if self._gradients is None:
            self._gradients, self._next = torch.zeros_like(self._qkv), t
        if t != self._next:
            raise RuntimeError(f"the backward pass reached step {t} of the past before step {self._next}")
        self._next = t - 1
        q, keys, values = self.seen(self._gradients, t)
        q[:, :, -1:].copy_(of_q)
        keys.add_(of_keys)
        values.add_(of_values)
        return self._gradients[t].flatten(1)


class _Remember(torch.autograd.Function):
    """Queries (R, H, 1, E) of step t, and keys and values (R, H, K, E) of the steps that it sees."""

    @staticmethod
    def forward(ctx: Any, qkv: Tensor, past: _Past, t: int) -> tuple[Tensor, ...]:
        ctx.past, ctx.t = past, t
        q, keys, values = past.seen(past._qkv, t)
        return q[:, :, -1:], keys, values

    @staticmethod
    def backward(ctx: Any, of_q: Tensor, of_keys: Tensor, of_values: Tensor) -> tuple[Tensor, None, None]:
        return ctx.past.add_gradients(ctx.t, of_q, of_keys, of_values), None, None


def _attend(q: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    if len(q) <= MOST_ROWS:
        return F.scaled_dot_product_attention(q, keys, values)
    parts = zip(*(torch.split(tensor, MOST_ROWS) for tensor in (q, keys, values)), strict=True)
    return torch.cat([F.scaled_dot_product_attention(*part) for part in parts])


def _plain(linears: Sequence[Any]) -> tuple[Tensor, Tensor]:
    """Matrices (G, in, out) and biases (G, out)."""
    matrices = torch.stack([linear.weight for linear in linears]).transpose(1, 2)
    return matrices, torch.stack([linear.bias for linear in linears])


def _after_norm(norms: Sequence[Any], linears: Sequence[Any]) -> tuple[Tensor, Tensor]:
    """The same for linear(norm(x)) as a function of x normalised without scale and shift."""
    matrices, biases = _plain(linears)
    scale, shift = (torch.stack(parts).unsqueeze(1) for parts in zip(*((n.weight, n.bias) for n in norms)))
    return matrices * scale.transpose(1, 2), torch.baddbmm(biases.unsqueeze(1), shift, matrices).squeeze(1)


def _rotated(matrices: Tensor, biases: Tensor, steps: int, heads: int) -> tuple[Tensor, Tensor]:
    """Of layers that make queries, keys and values: (G T, in, out) with the rotary angles of each step built in."""
    layers, rows, width = matrices.shape[0], matrices.shape[1] + 1, matrices.shape[2]
    half = width // 3 // heads // 2
    frequencies = ROPE_BASE ** -(torch.arange(half, device=biases.device) / half)
    angles = torch.arange(steps, device=biases.device)[:, None, None, None] * frequencies
    cos, sin = angles.cos(), angles.sin()
    joined = torch.cat((matrices, biases.unsqueeze(1)), 1).view(layers, 1, rows, 3 * heads, 2, half)
    first, second = joined[:, :, :, : 2 * heads].unbind(4)
    turned = torch.stack((first * cos - second * sin, second * cos + first * sin), 4)
    kept = joined[:, :, :, 2 * heads :].expand(-1, steps, -1, -1, -1, -1)
    whole = torch.cat((turned, kept), 3).view(layers * steps, rows, width)
    return whole[:, :-1], whole[:, -1]


def _condition_heads(
    condition_BTND: Tensor, matrices: Tensor, biases: Tensor, heads: int
) -> list[tuple[Tensor, Tensor]]:
    """Keys and values (B, H, N, E) of the condition, for each block (the slower) and step."""
    batch, _, tokens, width = condition_BTND.shape
    rows = condition_BTND.transpose(0, 1).reshape(1, -1, width).expand(len(matrices), -1, -1)
    kv = torch.baddbmm(biases.to(rows.dtype).unsqueeze(1), rows, matrices.to(rows.dtype))
    kv = kv.view(-1, batch, tokens, 2, heads, width // heads).transpose(2, 4)
    keys, values = kv.unbind(3)
    return list(zip(keys.unbind(0), values.unbind(0), strict=True))
