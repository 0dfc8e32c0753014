"""Behaviour cloning (RS-11): the weak policy that RL starts from. Shapes: B batch, F features, S state, A action."""

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import SftConfig
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.types import RECOVERY, TAKEN_OVER, Episode, UInt8Array
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.recording.episode_arrays import check_finite

EXPERT = "expert"
CHECKS = 40
"""How often in a training the error on held-out demonstrations is taken."""


@dataclass(frozen=True)
class SftResult:
    """What a training gave."""

    losses: NDArray[np.float32]
    """ImagePolicy.cloning_error of every gradient step's batch."""
    num_samples: int
    """Images trained on."""
    heldout_losses: Mapping[int, float]
    """The same of held-out demonstrations, by the gradient steps made; empty without any."""


@dataclass(frozen=True)
class _Frames:
    """What is learned from; a row per image."""

    features_BF: Tensor
    """The encoder's."""
    states_BS: Tensor
    """Seen with them."""
    actions_BA: Tensor
    """Demonstrated there."""

    def error(self, policy: ImagePolicy, rows: Tensor | slice = slice(None), noise: Tensor | float = 0.0) -> Tensor:
        """See ImagePolicy.cloning_error. noise: on the states."""
        return policy.cloning_error(self.features_BF[rows], self.states_BS[rows] + noise, self.actions_BA[rows])


def demonstrations(
    episodes: Iterable[Episode], count: int, behaviour: str = EXPERT, setting: str = "sft.num_demonstrations"
) -> list[Episode]:
    """Return the first `count` episodes of a behaviour that reach success after their expert has begun to act. setting:
    what asks for so many.

    Raises:
        ValueError: there are fewer.
    """
    successful = (
        episode for episode in episodes
        if episode.behaviour == behaviour and bool(episode.success.any())
        and not episode.success[: expert_from(episode) + 1].any()
    )
    demos = list(islice(successful, count))
    if len(demos) < count:
        raise ValueError(
            f"{setting} is {count}, but the data hold {len(demos)} successful {behaviour} episodes; collect more or "
            "ask for fewer"
        )
    return demos


def expert_from(episode: Episode) -> int:
    """The first step that its expert acted."""
    return int(episode.extra.get(TAKEN_OVER, 0))


def train_sft(
    policy: ImagePolicy, demos: Sequence[Episode], config: SftConfig, seed: int, *,
    reconstruct: Callable[[UInt8Array], UInt8Array] | None = None, noisy: Sequence[int] = (),
    twin: Callable[[Episode], Episode] | None = None,
) -> SftResult:
    """Fit the actor's mean to the demonstrated actions in place; critic and log standard deviation stay. With
    config.heldout the last demonstrations of each behaviour are not learned, and the weights with the least error on
    them are kept. Beside each demonstration that is learned or held out its `twin` is, too.

    Steps after the first success are left out: an episode ends there when a policy acts; and those of a recovery before
    its expert has taken over. The demonstrations also set
    the policy's feature normalisation. Every image counts once, and with `reconstruct` (the tokenizer's decode of
    encode, uint8 (B, H, W, 3)) once more as the world model will show it. `seed` draws the batches (stream `sft`) and
    the noise of config.state_noise_m on the values `noisy` of the states (`sft_states`).
    With one seed and one number of torch threads the result is bit-identical on a CPU.

    Raises:
        ValueError: no demonstrations, none left to learn or to hold out, one that is not the expert's, or as
            check_finite.
    """
    others = {episode.behaviour for episode in demos} - {EXPERT, RECOVERY}
    if not demos or others:
        raise ValueError(f"behaviour cloning needs {EXPERT} demonstrations, got {len(demos)} with {sorted(others)}")
    kept, held = _split(demos, config.heldout)
    if twin:
        kept, held = ([each for demo in side for each in (demo, twin(demo))] for side in (kept, held))
    check_finite([*kept, *held])
    learned = _frames(policy, kept, reconstruct)
    heldout = _frames(policy, held, reconstruct) if held else None
    policy.fit_normaliser(learned.features_BF)
    optimizer = torch.optim.AdamW(
        policy.actor.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    generator, hiding, reading = (torch_stream(seed, name) for name in ("sft", "sft_dropout", "sft_states"))
    noise = torch.zeros(config.batch_size, learned.states_BS.shape[1])
    dropout, losses, errors = policy.config.dropout, list[Tensor](), dict[int, float]()
    best, actor = copy.deepcopy(policy.state_dict()), cast(Any, policy.actor)
    for step in range(1, config.num_iterations + 1):
        index = torch.randint(len(learned.features_BF), (config.batch_size,), generator=generator).to(policy.device)
        if dropout:
            draws = torch.rand(config.batch_size, policy.config.projection, generator=hiding)
            actor.kept = (draws >= dropout).float().to(policy.device) / (1 - dropout)
        if config.state_noise_m:
            noise[:, noisy] = config.state_noise_m * torch.randn(config.batch_size, len(noisy), generator=reading)
        loss = learned.error(policy, index, noise.to(policy.device))
        actor.kept = None
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        losses.append(loss.detach())
        if heldout and (step % max(1, config.num_iterations // CHECKS) == 0 or step == config.num_iterations):
            with torch.no_grad():
                errors[step] = float(heldout.error(policy))
            if errors[step] == min(errors.values()):
                best = copy.deepcopy(policy.state_dict())
    if heldout:
        policy.load_state_dict(best)
    return SftResult(torch.stack(losses).cpu().numpy(), len(learned.features_BF), errors)


def _split(demos: Sequence[Episode], share: float) -> tuple[list[Episode], list[Episode]]:
    """Those to learn and to hold out, both in order: the last ones of each behaviour are held out."""
    held = set[int]()
    for behaviour in sorted({demo.behaviour for demo in demos}):
        rows = [i for i, demo in enumerate(demos) if demo.behaviour == behaviour]
        count = round(share * len(rows))
        if share and not 0 < count < len(rows):
            raise ValueError(f"sft.heldout {share} of {len(rows)} {behaviour} demonstrations is {count}; give a share "
                             "that holds at least one out and leaves one")
        held.update(rows[len(rows) - count :])
    return [demo for i, demo in enumerate(demos) if i not in held], [demos[i] for i in sorted(held)]


def _frames(
    policy: ImagePolicy, demos: Sequence[Episode], reconstruct: Callable[[UInt8Array], UInt8Array] | None
) -> _Frames:
    """Arguments: as of train_sft."""
    ends = [int(demo.success.argmax()) if demo.success.any() else demo.num_steps for demo in demos]
    images, states, actions = (
        np.concatenate([getattr(demo, name)[expert_from(demo) : end] for demo, end in zip(demos, ends, strict=True)])
        for name in ("images", "states", "actions")
    )
    states_BS, actions_BA = (torch.from_numpy(a.astype(np.float32)).to(policy.device) for a in (states, actions))
    features = [policy.features(images)]
    if reconstruct is not None:
        features.append(policy.features(reconstruct(images)))
        states_BS, actions_BA = torch.cat([states_BS, states_BS]), torch.cat([actions_BA, actions_BA])
    return _Frames(torch.cat(features), states_BS, actions_BA)
