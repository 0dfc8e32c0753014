"""Rewards of a recorded run, evaluated again from the bag."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from recording_graph import NUM_ENVS, Graph, write
from recording_samples import make_spec

from wm_nodes.apps.cli import main
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.policy_rl.rescoring import model_of_run, rescore_bag
from wm_nodes.recording import BagError, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.layout import Tiles
from wm_nodes.reward import EncoderDistance, EndogenousReward, RewardInput, RewardModel, RuleReward
from wm_nodes.training.run_record import RunRecord


@dataclass
class JudgedGraph(Graph):
    """Publishes the rewards of a real model, and a goal for every episode."""

    model: RewardModel = field(default_factory=RuleReward)
    tamper: int = -1

    def __post_init__(self) -> None:
        shape = (64, self.spec.height, self.spec.width, 3)
        self.goal_images = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
        super().__post_init__()

    def start(self, mask: NDArray[np.bool_]) -> None:
        super().start(mask)
        if mask.any():
            tiles = Tiles.of(NUM_ENVS, self.spec.height, self.spec.width)
            goals = m.message_type(topics.GOAL.msgtype)(
                header=m.header(self.now_ns, ""), session=0, seq=0, task="", instruction="",
                goal_image=m.image_message(tiles.tile(self.goal_images[self.episode_id]), self.now_ns),
                goal_found=(self.episode_id % 2).astype(np.uint8), episode_id=self.episode_id.copy(),
            )
            self.publish(topics.GOAL, goals)

    def reward(self, row: dict[str, NDArray[Any]], stamp_ns: int) -> Any:
        step = RewardInput(
            images=row["images"], next_images=row["next_images"], success_probability=self.success, valid=~self.ended,
            uncertainty=np.zeros(NUM_ENVS, np.float32), goals=self.goal_images[self.episode_id],
            goal_found=self.episode_id % 2 == 1,
        )
        result = self.model.evaluate(step)
        message = super().reward(row, stamp_ns)
        message.total, message.dense, message.sparse = result.total, result.dense, result.sparse
        message.success, message.valid = result.success, result.valid.astype(np.uint8)
        message.component_names = list(result.components)
        message.components = np.stack(list(result.components.values()), axis=1).reshape(-1)
        message.reward_name, message.reward_version = self.model.name, self.model.version
        if self.step_id == self.tamper:
            message.total = np.nextafter(message.total, np.float32(10), dtype=np.float32)
        return message


PIXELS = EncoderDistance(lambda images: images.float(), scale=255.0)
MODELS: list[RewardModel] = [RuleReward(2.0), EndogenousReward(load_config("smoke").reward, PIXELS)]


def recorded_run(path: Path, model: RewardModel, **options: Any) -> Path:
    graph = JudgedGraph(make_spec(num_envs=NUM_ENVS), model=model, **options)
    graph.rollout(1, 20)
    graph.rollout(2, 20)
    return write(path, graph)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_rewards_of_a_bag_are_bit_equal_when_evaluated_again(tmp_path: Path, model: RewardModel) -> None:
    report = rescore_bag(recorded_run(tmp_path / "bag", model), model)
    assert report.equal, report.different
    assert (report.compared, report.unrewarded, report.without_images) == (40, 0, 0)


def test_one_unit_in_the_last_place_is_found(tmp_path: Path) -> None:
    report = rescore_bag(recorded_run(tmp_path / "bag", MODELS[0], tamper=7), MODELS[0])
    assert report.different == ["step_id 7: total"]
    assert not report.equal


def test_rewards_of_another_model_or_version_are_not_compared(tmp_path: Path) -> None:
    path = recorded_run(tmp_path / "bag", MODELS[0])
    with pytest.raises(BagError, match=r"rule rewards of version .* this model is"):
        rescore_bag(path, RuleReward(3.0))
    with pytest.raises(BagError, match="no reward named 'endogenous'"):
        rescore_bag(path, MODELS[1])


def test_the_command_builds_the_runs_reward_model_and_says_whether_the_bits_are_equal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_config("smoke")
    (tmp_path / "config.yaml").write_text(dump_config(config))
    model = RuleReward(config.reward.sparse_weight)
    assert main(["rescore", str(recorded_run(tmp_path / "bags" / "run", model))]) == 0
    assert capsys.readouterr().out.startswith("40 lock-steps evaluated again, 0 differ")
    assert main(["rescore", str(recorded_run(tmp_path / "bags" / "tampered", model, tamper=7))]) == 1
    assert capsys.readouterr().out.startswith("step_id 7: total\n40 lock-steps")
    assert main(["rescore", str(recorded_run(tmp_path / "bags" / "other", RuleReward(3.0)))]) == 2
    assert "build it with the weights and thresholds of the run's configuration" in capsys.readouterr().err
    assert main(["rescore", str(tmp_path / "nothing")]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_the_model_of_a_run_is_the_one_that_it_made_else_the_one_that_it_was_begun_with(tmp_path: Path) -> None:
    options = {"train-policy": {"model_dir": str(tmp_path / "mine")}}
    RunRecord(load_config("smoke", {"task": ""}).model_dump(), "smoke", options).write(tmp_path)
    assert model_of_run(tmp_path, "") == tmp_path / "mine"
    (tmp_path / "model").mkdir()
    assert model_of_run(tmp_path, "") == tmp_path / "model"
    (tmp_path / "other").mkdir()
    assert model_of_run(tmp_path / "other", "reach") == shipped_model("reach")
