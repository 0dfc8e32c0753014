"""Evaluate the rewards of a recorded run again with its reward model, and compare them bit by bit."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.lockstep import Rewards
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_reward
from wm_nodes.policy_rl.rollouts import reward_input
from wm_nodes.recording import Bag, BagError
from wm_nodes.recording.join import LockSteps
from wm_nodes.recording.rollouts import recorded_reward_name
from wm_nodes.reward import RewardModel, RewardResult, RuleReward
from wm_nodes.training.run_record import read_record


@dataclass
class RescoreReport:
    """How the rewards of a recording compare with those given again."""

    compared: int = 0
    """Lock-steps evaluated again."""
    different: list[str] = field(default_factory=list)
    """A line per lock-step whose rewards are not bit-equal."""
    unrewarded: int = 0
    """Lock-steps without reward, not compared."""
    without_images: int = 0
    """Lock-steps without images, not compared."""

    @property
    def equal(self) -> bool:
        """True when something was compared and nothing differed."""
        return self.compared > 0 and not self.different

    def text(self) -> str:
        return (
            f"{self.compared} lock-steps evaluated again, {len(self.different)} differ; not compared: "
            f"{self.unrewarded} without reward, {self.without_images} without images"
        )


def rescore_bag(path: Path, model: RewardModel, *, namespace: str | None = None) -> RescoreReport:
    """Evaluate `model` on every lock-step of a live recording and compare with the rewards recorded under its name.

    Raises:
        BagError: an unusable bag, no reward of this model in it, or rewards of another version of the model.
    """
    report = RescoreReport()
    with Bag(path) as bag:
        for step in LockSteps(bag, namespace=namespace, reward_name=model.name):
            if step.rewards is None:
                report.unrewarded += int(step.valid.any())
                continue
            if step.rewards.version != model.version:
                raise BagError(
                    f"{path} holds {model.name} rewards of version {step.rewards.version}, this model is "
                    f"{model.version}; build it with the weights and thresholds of the run's configuration"
                )
            if step.images is None or step.next_images is None:
                report.without_images += 1
                continue
            report.compared += 1
            given = reward_input(step.images, step.next_images, step, step.goals)
            wrong = _differences(step.rewards, model.evaluate(given))
            if wrong:
                report.different.append(f"step_id {step.step_id}: {', '.join(wrong)}")
    if not report.compared:
        raise BagError(f"{path} holds no reward named {model.name!r} with its images; record env/image and reward")
    return report


def recorded_model(
    bag: Path, config_file: str | None = None, model_dir: Path | None = None, device: str | None = None
) -> RewardModel:
    """Build the reward model of the run that a bag lies in.

    Args:
        config_file: default: config.yaml two folders above the bag.
        model_dir: its world model; default: `model` beside that file, else the shipped one.
        device: as the setting; default: the run's.

    Raises:
        BagError: the bag holds rewards that no reward model gives.
    """
    name = recorded_reward_name(bag)
    run_dir = bag.absolute().parent.parent
    config = load_config(config_file or str(run_dir / "config.yaml"), {"device": device} if device else {})
    if config.reward.factory:
        return make_reward(config, None)
    if name == "rule":
        return RuleReward(config.reward.sparse_weight)
    if name != "endogenous":
        raise BagError(f"{bag} holds rewards of {name or 'nobody'}; endogenous, rule and agent can be scored again")
    return make_endogenous_reward(config, model_dir or model_of_run(run_dir, config.task))


def model_of_run(run_dir: Path, task: str) -> Path:
    """The world model of a run: that which it made, else the one that it was begun with, else the shipped one of its
    task."""
    if (own := run_dir / "model").is_dir():
        return own
    record = read_record(run_dir)
    begun_with = [options.get("model_dir") for options in record.options.values()] if record else []
    return Path(begun_with[0]) if begun_with and begun_with[0] else shipped_model(task)


def _differences(recorded: Rewards, result: RewardResult) -> list[str]:
    pairs = {name: (getattr(recorded, name), getattr(result, name)) for name in ("total", "dense", "sparse", "success")}
    pairs["valid"] = recorded.valid, result.valid
    for column, name in enumerate(recorded.component_names):
        pairs[name] = recorded.components[:, column], result.components[name]
    return [name for name, (theirs, ours) in pairs.items() if not _bit_equal(theirs, ours)]


def _bit_equal(theirs: NDArray[np.generic], ours: NDArray[np.generic]) -> bool:
    return theirs.dtype == ours.dtype and theirs.tobytes() == ours.tobytes()
