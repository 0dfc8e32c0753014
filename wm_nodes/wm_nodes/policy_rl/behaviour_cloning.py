"""Behaviour cloning (RS-11): the weak policy that RL starts from. Shapes: B batch, F features, A action."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.schema import SftConfig
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.types import Episode, UInt8Array
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.recording.episode_arrays import check_finite

EXPERT = "expert"


@dataclass(frozen=True)
class SftResult:
    """losses: mean squared action error of every iteration's batch. num_samples: images trained on."""

    losses: NDArray[np.float32]
    num_samples: int


def demonstrations(episodes: Iterable[Episode], count: int) -> list[Episode]:
    """Return the first `count` expert episodes that reach success.

    Raises:
        ValueError: there are fewer.
    """
    successful = (episode for episode in episodes if episode.behaviour == EXPERT and bool(episode.success.any()))
    demos = list(islice(successful, count))
    if len(demos) < count:
        raise ValueError(
            f"sft.num_demonstrations is {count}, but the data hold {len(demos)} successful {EXPERT} episodes; collect "
            "more or ask for fewer"
        )
    return demos


def train_sft(
    policy: ImagePolicy, demos: Sequence[Episode], config: SftConfig, seed: int, *,
    reconstruct: Callable[[UInt8Array], UInt8Array] | None = None,
) -> SftResult:
    """Fit the actor's mean to the demonstrated actions in place; critic and log standard deviation stay.

    Steps after the first success are left out: an episode ends there when a policy acts. The demonstrations also set
    the policy's feature normalisation. Every image counts once, and with `reconstruct` (the tokenizer's decode of
    encode, uint8 (B, H, W, 3)) once more as the world model will show it. `seed` draws the batches (stream `sft`).
    With one seed and one number of torch threads the result is bit-identical on a CPU.

    Raises:
        ValueError: no demonstrations, one that is not the expert's, or as check_finite.
    """
    others = {episode.behaviour for episode in demos} - {EXPERT}
    if not demos or others:
        raise ValueError(f"behaviour cloning needs {EXPERT} demonstrations, got {len(demos)} with {sorted(others)}")
    check_finite(demos)
    steps = [int(demo.success.argmax()) if demo.success.any() else demo.num_steps for demo in demos]
    images, states, actions = (
        np.concatenate([getattr(demo, name)[:count] for demo, count in zip(demos, steps, strict=True)])
        for name in ("images", "states", "actions")
    )
    states_BS, actions_BA = (torch.from_numpy(a.astype(np.float32)).to(policy.device) for a in (states, actions))
    features = [policy.features(images)]
    if reconstruct is not None:
        features.append(policy.features(reconstruct(images)))
        states_BS, actions_BA = torch.cat([states_BS, states_BS]), torch.cat([actions_BA, actions_BA])
    features_BF = torch.cat(features)
    policy.fit_normaliser(features_BF)
    optimizer = torch.optim.Adam(policy.actor.parameters(), lr=config.learning_rate)
    generator = torch_stream(seed, "sft")
    losses = list[Tensor]()
    for _ in range(config.num_iterations):
        index = torch.randint(len(features_BF), (config.batch_size,), generator=generator).to(policy.device)
        mean_BA = policy.distribution(features_BF[index], states_BS[index]).mean_BA
        loss = (mean_BA - actions_BA[index]).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        losses.append(loss.detach())
    return SftResult(torch.stack(losses).cpu().numpy(), len(features_BF))
