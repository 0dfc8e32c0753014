"""Proximal policy optimisation on rollouts (RS-10). Shapes: T time, N environments, B samples of a minibatch,
F features, S state, A action.

loss = RS-10b clipped policy + value_weight * RS-10c value - entropy_weight * entropy
       + kl_reference_weight * KL(policy || SFT policy), summed over valid samples and divided by their number.

With ppo.advantage group this is GRPO: advantages are RS-10e's, and the critic is neither used nor trained.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from wm_nodes.config.schema import PpoConfig
from wm_nodes.core.device import DeviceError, explain_memory
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.advantages import GroupAdvantages, explained_variance, gae, group_advantages, masked_normalise
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.losses import approximate_kl, clip_fraction, clipped_policy_loss, value_loss
from wm_nodes.policy_rl.rollouts import Canceled, TensorRollout, check_whole_groups, tensors_of
from wm_nodes.training import checkpoint
from wm_nodes.training.ranks import Ranks
from wm_nodes.training.weights import check_same_layout

SAME_START = 0.1
"""Largest difference of a feature or state (m) between environments that begin at the same start: of rounding."""


@dataclass(frozen=True)
class PpoMetrics:
    """Means over the samples of the update's minibatches, the one included that target_kl stopped at; see
    docs/metrics.md."""

    loss_policy: float
    """RS-10b."""
    loss_value: float
    """RS-10c; NaN without a critic."""
    entropy: float
    """Of the policy, nats."""
    approx_kl: float
    """Of the policy that acted from the trained one, nats."""
    kl_reference: float
    """Of the trained policy from the reference, nats."""
    clip_fraction: float
    """Share of the samples whose ratio was clipped."""
    grad_norm: float
    """Before clipping."""
    learning_rate: float
    """Of the actor."""
    explained_variance: float
    """Of the returns by the critic; NaN without a critic."""
    mean_advantage_std: float
    """Standard deviation of the advantages trained on."""
    epochs: float
    """Passes made before target_kl stopped them (fractional)."""
    samples: int
    """Transitions trained on."""
    groups_without_signal: int | None = None
    """See GroupAdvantages; None with a critic."""
    episodes_without_return: int | None = None
    """See GroupAdvantages; None with a critic."""


@dataclass(frozen=True)
class _Samples:
    """The samples of one rollout to train on, flattened."""

    groups: GroupAdvantages | None
    """None with a critic."""
    features: Tensor
    """(B, F)."""
    states: Tensor
    """(B, S)."""
    actions: Tensor
    """(B, A), as executed."""
    logprobs: Tensor
    """(B,), of the policy that acted."""
    values: Tensor
    """(B,), of the critic that acted."""
    advantages: Tensor
    """(B,)."""
    returns: Tensor
    """(B,), the critic's targets."""


class PpoLearner:
    """Trains `policy` in place.

    Args:
        seed: of the minibatch order (stream `ppo_order`).
        ranks: this process's place among the learner's processes.
    """

    def __init__(self, policy: ImagePolicy, config: PpoConfig, *, seed: int, ranks: Ranks | None = None) -> None:
        self.policy, self.config, self.seed = policy, config, seed
        self.reference = policy.clone()
        self.ranks = ranks or Ranks()
        self.updates = 0
        critic = list(policy.critic.parameters())
        actor = [p for p in policy.parameters() if all(p is not c for c in critic)]
        self._optimizer = torch.optim.Adam(
            [{"params": actor, "lr": config.learning_rate}, {"params": critic, "lr": config.value_learning_rate}],
            eps=1e-5,
        )

    def update(
        self, rollout: Rollout | TensorRollout, *, should_stop: Callable[[], bool] | None = None
    ) -> PpoMetrics:
        """Train on one rollout; see Learner.update.

        Raises:
            Canceled: should_stop, asked before every minibatch, said so on some rank; nothing has changed then.
            FloatingPointError: a loss, a gradient or a new weight is not finite; nothing has changed then.
            DeviceError: too little memory for the minibatches; nothing has changed then.
            ValueError: no valid sample, samples whose log_prob or value is unknown (NaN), or no groups of equal starts.
        """
        before = {name: tensor.clone() for name, tensor in self.policy.state_dict().items()}
        optimizer_before = {name: t.clone() for name, t in checkpoint.optimizer_tensors(self._optimizer).items()}
        try:
            settings = {"ppo__num_envs": self.config.num_envs, "ppo__minibatch_size": self.config.minibatch_size}
            with explain_memory(self.policy.device, **settings):
                metrics = self._update(rollout, should_stop)
        except (Canceled, FloatingPointError, DeviceError):
            self.policy.load_state_dict(before)
            checkpoint.restore_optimizer(self._optimizer, optimizer_before)
            raise
        self.updates += 1
        return metrics

    def save(self, path: Path) -> None:
        """Write optimiser, reference policy and counters, atomically."""
        sections = {
            "optimizer": checkpoint.optimizer_tensors(self._optimizer), "reference": self.reference.state_dict()
        }
        checkpoint.write_checkpoint(path, sections, {"updates": str(self.updates), "seed": str(self.seed)})

    def load(self, path: Path) -> None:
        """Continue exactly from save().

        Raises:
            ValueError: the file is of another architecture or seed.
        """
        tensors, metadata = checkpoint.read_checkpoint(path)
        if int(metadata["seed"]) != self.seed:
            raise ValueError(f"{path} has seed {metadata['seed']}, this run has {self.seed}; use a new run folder")
        reference = checkpoint.section(tensors, "reference.")
        check_same_layout(self.reference.state_dict(), reference, what=str(path))
        self.reference.load_state_dict(reference)
        checkpoint.restore_optimizer(self._optimizer, checkpoint.section(tensors, "optimizer."))
        self.updates = int(metadata["updates"])

    def _update(self, rollout: Rollout | TensorRollout, should_stop: Callable[[], bool] | None) -> PpoMetrics:
        config = self.config
        samples = self._samples(tensors_of(rollout, self.policy))
        count = len(samples.actions)
        totals: dict[str, float] = {}
        read = trained = 0
        groups = samples.groups
        policy_frozen = groups is None and self.updates < config.value_warmup_updates
        num_minibatches = max(1, round(count / config.minibatch_size))
        stop = False
        for epoch in range(config.epochs):
            order = torch.randperm(count, generator=torch_stream(self.seed, "ppo_order", self.updates, epoch))
            for index in order.to(self.policy.device).chunk(num_minibatches):
                if self.ranks.agree(should_stop is not None and should_stop()):
                    raise Canceled(f"update {self.updates} stopped after {trained} samples")
                terms = self._minibatch(samples, index, policy_frozen)
                for name, value in terms.items():
                    totals[name] = totals.get(name, 0.0) + value * len(index)
                read += len(index)
                stop = 0 < config.target_kl < terms["approx_kl"]
                if stop:
                    break
                trained += len(index)
            if stop:
                break
        if not bool(torch.stack([torch.isfinite(parameter).all() for parameter in self.policy.parameters()]).all()):
            raise self._not_finite("weight")
        return PpoMetrics(
            **{name: value / read for name, value in totals.items()}, learning_rate=config.learning_rate,
            explained_variance=explained_variance(
                samples.values, samples.returns, torch.ones_like(samples.values, dtype=torch.bool)
            ),
            mean_advantage_std=float(samples.advantages.std(correction=0)), epochs=trained / count, samples=count,
            groups_without_signal=groups.groups_without_signal if groups else None,
            episodes_without_return=groups.episodes_without_return if groups else None,
        )

    def _minibatch(self, samples: _Samples, index: Tensor, policy_frozen: bool) -> dict[str, float]:
        """One gradient step on the samples `index` unless their KL is above target_kl, this rank computing its share;
        returns means over all of them."""
        config, own = self.config, self.ranks.share(index)
        features, states = samples.features[own], samples.states[own]
        distribution = self.policy.distribution(features, states)
        with torch.no_grad():
            reference = self.reference.distribution(features, states)
        logprobs = distribution.logprob(samples.actions[own])
        old = samples.logprobs[own]
        policy_losses = clipped_policy_loss(logprobs, old, samples.advantages[own], clip=config.clip)
        value_losses = torch.full_like(policy_losses, math.nan)
        entropies, kls = distribution.entropy(), distribution.kl(reference)
        loss = (policy_losses - config.entropy_weight * entropies + config.kl_reference_weight * kls).sum()
        if samples.groups is None:
            values = self.policy.value_beside(distribution, features, states)
            value_losses = value_loss(values, samples.values[own], samples.returns[own], clip=config.value_clip)
            critic_loss = config.value_weight * value_losses.sum()
            loss = critic_loss if policy_frozen else critic_loss + loss
        self._optimizer.zero_grad(set_to_none=True)
        (loss / len(index)).backward()  # type: ignore[no-untyped-call]
        self.ranks.sum_gradients(self.policy)
        norm = clip_grad_norm_(self.policy.parameters(), config.max_grad_norm)
        with torch.no_grad():
            sums = torch.stack([
                policy_losses.sum(), value_losses.sum(), entropies.sum(), approximate_kl(logprobs, old).sum(),
                kls.sum(), clip_fraction(logprobs, old, clip=config.clip).sum(),
            ])
        self.ranks.sum_(sums)
        names = ("loss_policy", "loss_value", "entropy", "approx_kl", "kl_reference", "clip_fraction")
        *told, grad_norm = torch.cat((sums / len(index), norm.view(1))).tolist()  # the one wait for the device
        if not math.isfinite(grad_norm):
            raise self._not_finite("gradient")
        means = dict(zip(names, told, strict=True))
        finite = ("loss_policy", "entropy", "kl_reference", *(["loss_value"] if samples.groups is None else []))
        if not all(math.isfinite(means[name]) for name in finite):
            raise self._not_finite("loss")
        if not 0 < config.target_kl < means["approx_kl"]:
            self._optimizer.step()
            with torch.no_grad():
                self.policy.log_std_A.clamp_(min=config.min_log_std)
        return means | {"grad_norm": grad_norm}

    def _not_finite(self, what: str) -> FloatingPointError:
        return FloatingPointError(
            f"a PPO {what} is not finite in update {self.updates}, which was undone; lower ppo.learning_rate"
        )

    @torch.no_grad()
    def _samples(self, rollout: TensorRollout) -> _Samples:
        groups = self._group_advantages(rollout) if self.config.advantage == "group" else None
        valid_TN = rollout.valid_TN if groups is None else groups.counted_TN
        chosen = valid_TN.reshape(-1).nonzero().squeeze(1)
        if not len(chosen):
            what = "valid transition: no valid reward or step" if groups is None else "first episode with every reward"
            raise ValueError(f"the rollout has no {what}; the rewards in the run's bag say why (`reason`): with "
                             "reward.dense_weight that no goal was imagined, and 0 pays success alone")
        known_TN = torch.isfinite(rollout.logprobs_TN)
        if groups is None:
            known_TN &= torch.isfinite(rollout.values_TN)
        unknown = valid_TN & ~known_TN
        if unknown.any():
            raise ValueError(
                f"{int(unknown.sum())} of {len(chosen)} valid transitions have no log_prob or value; PPO trains "
                "on rollouts of a policy that publishes both"
            )
        for name, column_TN in (("state", rollout.states_TN), ("action", rollout.actions_TN)):
            if bool((valid_TN & ~torch.isfinite(column_TN).all(-1)).any()):
                raise ValueError(f"a valid transition has a {name} that is not finite; mark it valid=False")
        if groups is None:
            advantages, returns = gae(
                torch.where(valid_TN, rollout.rewards_TN, 0.0), rollout.values_TN, self._next_values(rollout),
                rollout.terminated_TN, rollout.truncated_TN, valid_TN,
                gamma=self.config.gamma, lambda_=self.config.gae_lambda,
            )
            advantages = masked_normalise(advantages, valid_TN, floor=self.config.advantage_floor)
        else:
            advantages, returns = groups.advantages_TN, torch.zeros_like(groups.advantages_TN)
        columns = (
            rollout.features_TN, rollout.states_TN, rollout.actions_TN, rollout.logprobs_TN, rollout.values_TN,
            advantages, returns,
        )
        return _Samples(groups, *(column.flatten(0, 1)[chosen] for column in columns))

    def _group_advantages(self, rollout: TensorRollout) -> GroupAdvantages:
        """Raises ValueError unless every environment's first episode began as the others of its group."""
        config, (steps, num_envs) = self.config, rollout.valid_TN.shape
        check_whole_groups(num_envs, config.group_size)
        if steps > config.num_steps:
            raise ValueError(
                f"of {steps} lock-steps most would be left out, as only first episodes count; step ppo.num_envs "
                f"({config.num_envs}) environments at a time"
            )
        first = torch.cat((rollout.features_TN[0], rollout.states_TN[0]), -1)
        groups = first.view(-1, config.group_size, first.shape[-1])
        if bool(((groups - groups[:, :1]).abs() > SAME_START).any()):
            raise ValueError(
                f"{config.group_size} neighbouring environments began at different starts; collect with the learner's "
                "ppo.advantage and ppo.group_size"
            )
        return group_advantages(
            rollout.rewards_TN, rollout.terminated_TN, rollout.truncated_TN, rollout.valid_TN,
            group_size=config.group_size, by_std=config.group_std, leave_one_out=config.leave_one_out,
        )

    def _next_values(self, rollout: TensorRollout) -> Tensor:
        """Values (T, N) of the observations that steps reached: the next row's where the episode goes on, else the
        critic's own, computed only where a bootstrap needs it."""
        following = torch.cat([rollout.values_TN[1:], torch.zeros_like(rollout.values_TN[:1])])
        values = torch.where(rollout.valid_TN, following, 0.0)
        needed = rollout.needs_bootstrap().flatten().nonzero().squeeze(1)
        if len(needed):
            features, states = (c.flatten(0, 1)[needed] for c in (rollout.next_features_TN, rollout.next_states_TN))
            values.view(-1)[needed] = self.policy.value(features, states)
        return values
