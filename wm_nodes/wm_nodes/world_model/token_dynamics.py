"""The next-frame model over lookup-free quantised tokens: masked-token prediction and parallel decoding.

Shapes: B batch, T transitions, S tokens per frame, D bits per token, N condition tokens, K done heads, J tasks,
A action, P state.

A step's input at one position is the token of frame t plus that of frame t + 1 as far as it is decided. The past is
therefore always seen complete, whatever is masked, and nothing of frame t + 1 has to be in the cache before the step.
The commit pass, with the whole of frame t + 1 decided, writes the cache and gives the done signal of frame t + 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wm_nodes.config.schema import WorldModelConfig
from wm_nodes.world_model.conditions import ActionCondition
from wm_nodes.world_model.decoding import Logits, code_parts, code_targets, decode_frame
from wm_nodes.world_model.dynamics import Caches, DoneHeads
from wm_nodes.world_model.state_change import StateChange
from wm_nodes.world_model.transformer import RingCache, SpatioTemporalTransformer


@dataclass(frozen=True)
class TokenPrediction:
    """logits: of the tokens of frame t + 1, parts of (B, T, S, V_i). done_logits_BTKJ: of frame t + 1."""

    logits: Logits
    done_logits_BTKJ: Tensor


class TokenActionModel(nn.Module):
    """WM_act over discrete tokens; stands in for ActionModel in the imagined environment. It reads no positions,
    whatever num_positions is."""

    def __init__(
        self, config: WorldModelConfig, *, num_tokens: int, latent_dim: int, action_dim: int, state_dim: int,
        num_tasks: int, num_positions: int = 0, measured: tuple[int, ...] = (),
        differences: Sequence[tuple[int, int]] = (),
    ) -> None:
        super().__init__()
        if config.state_model_iterations:
            raise ValueError("world_model.state_model_iterations goes with tokenizer.kind continuous alone; set it 0")
        width = config.width
        self.num_tokens, self.latent_dim, self.num_passes = num_tokens, latent_dim, config.decoding_steps
        self.embed = nn.Linear(latent_dim, width)
        self.embed_next = nn.Linear(latent_dim, width)
        self.undecided = nn.Parameter(torch.randn(width) * 0.5)
        self.position = nn.Parameter(torch.randn(num_tokens, width) * 0.5)
        self.register = nn.Parameter(torch.randn(1, width) * 0.5)
        self.trunk = SpatioTemporalTransformer(width, config.depth, config.num_heads, config.window)
        self.heads = nn.ModuleList(nn.Linear(width, 2**bits) for bits in code_parts(latent_dim))
        self.copy_bias = nn.Parameter(torch.full((len(self.heads),), 2.0))
        self.done = DoneHeads(width, config.num_done_heads, num_tasks)
        self.condition = ActionCondition(action_dim, state_dim, width)
        self.state_change = StateChange(action_dim, state_dim, latent_dim, measured) if measured else None
        self.state_model = None

    def forward(
        self, bits_BTSD: Tensor, next_bits_BTSD: Tensor, decided_BTS: Tensor, condition_BTND: Tensor,
        caches: Caches | None = None,
    ) -> TokenPrediction:
        """Predict frame t + 1 from frames 0..t and the decided tokens of frame t + 1."""
        decided = decided_BTS.unsqueeze(-1)
        drafts = torch.where(decided, self.embed_next(next_bits_BTSD), self.undecided)
        tokens = self.embed(bits_BTSD) + drafts + self.position
        register = self.register.to(tokens.dtype).expand(*tokens.shape[:2], 1, -1)
        features = self.trunk(torch.cat((tokens, register), 2), condition_BTND, caches)
        tokens, register = features[:, :, :-1], features[:, :, -1]
        logits = tuple(
            head(tokens).float().scatter_add(-1, code.unsqueeze(-1), bias.expand(*code.shape, 1))
            for head, code, bias in zip(self.heads, code_targets(bits_BTSD), self.copy_bias, strict=True)
        )
        return TokenPrediction(logits, self.done(tokens, register)[0])

    def advance(
        self, bits_NSD: Tensor, actions_NA: Tensor, states_NP: Tensor, next_states_NP: Tensor, caches: list[RingCache]
    ) -> tuple[Tensor, Tensor]:
        """One environment step: bits (N, S, D) of the next frame, K passes of argmax and a commit pass, and its done
        logits (N, K, J)."""
        condition = self.condition(actions_NA[:, None], states_NP[:, None], next_states_NP[:, None])
        now = bits_NSD.unsqueeze(1)

        def predict(drafts: Tensor, decided: Tensor) -> Logits:
            prediction = self(now, drafts.unsqueeze(1), decided.unsqueeze(1), condition, caches)
            return tuple(part[:, 0] for part in prediction.logits)

        times = caches[0].times
        times.peeking = True
        frame = decode_frame(predict, bits_NSD, self.num_passes).bits_BSD
        times.peeking = False
        everything = torch.ones(now.shape[:-1], dtype=torch.bool, device=now.device)
        committed = self(now, frame.unsqueeze(1), everything, condition, caches)
        return frame, committed.done_logits_BTKJ[:, 0]
