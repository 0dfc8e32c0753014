"""The next-frame model over continuous latents (RS-1): (x_t+1, d_t+1) from frames 0..t and a condition.

Shapes: B batch, T frames, S tokens per frame, D values per token, N condition tokens, K done heads, J tasks,
A action, P state, Q probed positions.

Economy: the trunk reads frame t and its condition once, and from the same features come frame t + 1 (as a residual on
frame t), the positions of its objects, and the done signal of frame t + 1. A terminal frame therefore costs no extra
pass. The first frame has no done signal; episodes start unfinished.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from wm_nodes.config.schema import WorldModelConfig
from wm_nodes.world_model.conditions import ActionCondition
from wm_nodes.world_model.state_change import StateChange
from wm_nodes.world_model.state_model import StateModel
from wm_nodes.world_model.tokenizer import NUM_POSITIONS, normalise_tokens
from wm_nodes.world_model.transformer import RingCache, SpatioTemporalTransformer, TemporalCache

Caches = list[TemporalCache] | list[RingCache]


@dataclass(frozen=True)
class Prediction:
    """What the model says of frame t + 1, for each frame t."""

    change_BTSD: Tensor
    """Added to the latents of frame t to give frame t + 1, before normalisation."""
    positions_BTQ: Tensor
    """Of frame t + 1, in the probe's units (zero mean, unit variance)."""
    done_logits_BTKJ: Tensor
    """Of frame t + 1, per head and task."""


def pooled_features(tokens_BTSD: Tensor, register_BTD: Tensor) -> Tensor:
    """What done heads see of the last layer, (B, T, 3 D): mean and maximum over the tokens, and the register."""
    return torch.cat((tokens_BTSD.mean(2), tokens_BTSD.amax(2), register_BTD), -1)


class DoneHeads(nn.Module):
    """K independent MLPs on the frame's pooled temporal features; the minimum over heads is the done signal.

    `num_positions` > 0: a head beside them reads positions off the same features, and the done heads see what it reads
    (without a gradient, so that it stays an estimate of positions). Success is a rule about positions.
    `told`: a StateModel has the done heads; there are none here.
    """

    def __init__(
        self, width: int, num_heads: int, num_tasks: int, num_positions: int = 0, *, told: bool = False
    ) -> None:
        super().__init__()
        self.num_heads, self.num_tasks, self.num_positions = num_heads, num_tasks, num_positions
        inputs = 3 * width + num_positions
        self.positions = (
            nn.Sequential(nn.Linear(3 * width, width), nn.SiLU(), nn.Linear(width, num_positions))
            if num_positions
            else None
        )
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, num_tasks))
            for _ in range(0 if told else num_heads)
        )
        for head in self.heads:
            nn.init.constant_(head[-1].bias, -2.0)  # type: ignore[index]

    def forward(
        self, tokens_BTSD: Tensor, register_BTD: Tensor, told_BTKJ: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Done logits (B, T, K, J), where they are told these, and positions (B, T, num_positions), float32."""
        pooled = pooled_features(tokens_BTSD, register_BTD)
        positions = pooled[..., :0].float()
        if self.positions is not None:
            positions = self.positions(pooled).float()
            pooled = torch.cat((pooled, positions.detach().to(pooled.dtype)), -1)
        if told_BTKJ is not None:
            return told_BTKJ, positions
        return torch.stack([head(pooled) for head in self.heads], 2).float(), positions


class ConditionMap(nn.Module):
    """An addition to every token's input that depends on the whole condition and on the token's place.

    Where the tool is seen depends on all values of its pose together. Cross-attention mixes one value's token at a
    time, so it needs many iterations to learn that; here an MLP reads their sum, and every place has its own outputs.
    """

    RANK = 32

    def __init__(self, width: int, hidden: int, num_tokens: int) -> None:
        super().__init__()
        self.num_tokens = num_tokens
        self.read = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(),
            nn.Linear(hidden, num_tokens * self.RANK),
        )
        self.out = nn.Linear(self.RANK, width)

    def forward(self, condition_BTND: Tensor) -> Tensor:
        """(B, T, S, D)."""
        values: Tensor = self.read(condition_BTND.sum(2))
        out: Tensor = self.out(values.view(*values.shape[:2], self.num_tokens, self.RANK))
        return out


class FrameModel(nn.Module):
    """Trunk and heads shared by the action model and the text model; they differ in their condition tokens."""

    def __init__(
        self, config: WorldModelConfig, num_tokens: int, latent_dim: int, num_tasks: int, num_positions: int,
        told: bool = False,
    ) -> None:
        super().__init__()
        self.condition_map: ConditionMap | None = None
        width = config.width
        self.num_tokens, self.latent_dim, self.num_tasks = num_tokens, latent_dim, num_tasks
        self.embed = nn.Linear(latent_dim, width)
        self.position = nn.Parameter(torch.randn(num_tokens, width) * 0.5)
        self.register = nn.Parameter(torch.randn(1, width) * 0.5)
        self.trunk = SpatioTemporalTransformer(width, config.depth, config.num_heads, config.window)
        self.change = nn.Linear(width, latent_dim)
        nn.init.zeros_(self.change.weight)
        nn.init.zeros_(self.change.bias)
        self.done = DoneHeads(width, config.num_done_heads, num_tasks, num_positions, told=told)

    def predict(
        self, latents_BTSD: Tensor, condition_BTND: Tensor, caches: Caches | None = None,
        visible_BN: Tensor | None = None, told_BTKJ: Tensor | None = None,
    ) -> Prediction:
        """Predict frame t + 1 for each of T given frames; later frames never influence earlier predictions.

        visible_BN: False where a condition token is padding. told_BTKJ: done logits of t + 1 that DoneHeads is told.
        """
        tokens = self.embed(latents_BTSD) + self.position
        if self.condition_map is not None:
            tokens = tokens + self.condition_map(condition_BTND)
        register = self.register.to(tokens.dtype).expand(*tokens.shape[:2], 1, -1)
        features = self.trunk(torch.cat((tokens, register), 2), condition_BTND, caches, visible_BN)
        tokens, register = features[:, :, :-1], features[:, :, -1]
        logits, positions = self.done(tokens, register, told_BTKJ)
        return Prediction(self.change(tokens).float(), positions, logits)


class ActionModel(FrameModel):
    """WM_act: the environment of the policy. What predicts the measured values of its state: state_model where
    world_model.state_model_iterations says so, else state_change; both None where the whole state is commanded."""

    def __init__(
        self, config: WorldModelConfig, *, num_tokens: int, latent_dim: int, action_dim: int, state_dim: int,
        num_tasks: int, num_positions: int = NUM_POSITIONS, measured: tuple[int, ...] = (),
        differences: Sequence[tuple[int, int]] = (),
    ) -> None:
        told = config.state_model_iterations > 0
        super().__init__(config, num_tokens, latent_dim, num_tasks, num_positions, told=told)
        self.condition = ActionCondition(action_dim, state_dim, config.width)
        if config.condition_map:
            self.condition_map = ConditionMap(config.width, config.condition_map, num_tokens)
        self.state_change: StateChange | None = None
        self.state_model: StateModel | None = None
        if told:
            self.state_model = StateModel(state_dim, measured, differences, num_tasks, config.num_done_heads)
        elif measured:
            self.state_change = StateChange(action_dim, state_dim, latent_dim, measured)

    def forward(
        self, latents_BTSD: Tensor, actions_BTA: Tensor, states_BTP: Tensor, next_states_BTP: Tensor,
        caches: Caches | None = None,
    ) -> Prediction:
        condition = self.condition(actions_BTA, states_BTP, next_states_BTP)
        return self.predict(latents_BTSD, condition, caches, told_BTKJ=self.told(next_states_BTP, states_BTP))

    @torch.no_grad()
    def told(self, states_BTP: Tensor, earlier_BTP: Tensor) -> Tensor | None:
        """Done logits of the states, with those of a step before; None: the done heads read them off the picture."""
        return None if self.state_model is None else self.state_model.done_logits(states_BTP, earlier_BTP)

    def advance(
        self, latents_NSD: Tensor, actions_NA: Tensor, states_NP: Tensor, next_states_NP: Tensor,
        caches: list[RingCache],
    ) -> tuple[Tensor, Tensor]:
        """One environment step: latents (N, S, D) of the next frame and its done logits (N, K, J)."""
        prediction = self(
            latents_NSD[:, None], actions_NA[:, None], states_NP[:, None], next_states_NP[:, None], caches
        )
        return normalise_tokens(latents_NSD + prediction.change_BTSD[:, 0]), prediction.done_logits_BTKJ[:, 0]


def done_signal(done_logits_BKJ: Tensor) -> tuple[Tensor, Tensor]:
    """RS-1d: pessimistic done probability (B, J), the minimum over heads, and the heads' standard deviation (B, J)."""
    probabilities = done_logits_BKJ.sigmoid()
    return probabilities.amin(-2), probabilities.std(-2, correction=0)


def task_done_signal(done_logits_BKJ: Tensor, tasks_B: Tensor) -> tuple[Tensor, Tensor]:
    """done_signal of each row's own task: probability and standard deviation, (B,). tasks_B: WorldModels.task_index."""
    probability, spread = (values.gather(1, tasks_B.unsqueeze(1))[:, 0] for values in done_signal(done_logits_BKJ))
    return probability, spread
