"""World models of robots that the product does not know, from bags: states that are measured, commanded, or none."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from examples import own_environment
from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import CommandedMove
from wm_nodes.core.types import Episode
from wm_nodes.environments.batch import EnvironmentBatch
from wm_nodes.policy_rl.factories import make_imagined_environment, make_policy
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.initial_policy import STARTS
from wm_nodes.policy_rl.pretraining import model_from_data, read_recordings
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.world_model import (
    ActionModel,
    DeviceEnvironment,
    ImaginedEnvironment,
    Tokenizer,
    load_model_folder,
    save_model_folder,
)
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.validation.acceptance import report_when_made

TINY = {
    "task": "", "tokenizer.width": 16, "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8,
    "tokenizer.num_iterations": 4, "tokenizer.decoder_iterations": 0, "tokenizer.batch_size": 8,
    "world_model.width": 16, "world_model.num_heads": 2, "world_model.num_iterations": 4, "world_model.batch_size": 4,
    "world_model.rollout_steps": [2], "reward.dense_weight": 0.0,
}
NO_STATE = {"state_names": (), "state_units": ()}


def record(folder: Path, count: int = 12, instructions: Sequence[str] = (), **changes: Any) -> Path:
    """A bag of random episodes of the arm, of what `changes` of its spec leave of the state. instructions: of the
    episodes in turn; none: that of the spec."""
    arm = EnvironmentBatch(own_environment.SPEC, [own_environment.Arm()], 0)
    spec = replace(arm.spec, **changes)
    stream = numpy_stream(0, "random actions")
    with EpisodeBagWriter(folder, spec, run_id="lab", start_ns=1) as bag:
        for number in range(count):
            shown, actions, ended = [arm.reset()], list[Any](), False
            won = [False]
            while not ended:
                actions.append(stream.uniform(-1, 1, (1, 6)).astype(np.float32))
                result = arm.step(actions[-1])
                shown.append(result.observation)
                won.append(bool(result.success_probability[0]))
                ended = bool(result.terminated[0] | result.truncated[0])
            steps = len(actions)
            bag.write(Episode(
                np.stack([one.image[0] for one in shown]), np.stack([one.state[0, : spec.state_dim] for one in shown]),
                np.concatenate(actions), np.zeros((steps + 1, 0), np.float32), np.array(won),
                np.zeros(steps, np.float32), bool(won[-1]), not won[-1], spec.task,
                instructions[number % len(instructions)] if instructions else spec.instruction, "random", number,
                number + 1, spec.source,
            ))
    return folder


def model_of(bag: Path, config: RunConfig, run_dir: Path) -> Path:
    """The folder of a model that is trained on a bag."""
    return model_from_data(*read_recordings([bag], config), config, run_dir / "model")


@pytest.fixture
def config() -> RunConfig:
    torch.set_num_threads(1)
    return load_config("smoke", TINY)


@pytest.mark.parametrize("kind", ["continuous", "lfq"])
def test_an_arm_without_any_state_is_modelled_and_acted_on_by_its_pictures_alone(
    kind: str, config: RunConfig, tmp_path: Path
) -> None:
    config = config.with_values(tokenizer=config.tokenizer.with_values(kind=kind))
    folder = model_of(record(tmp_path / "bag", **NO_STATE), config, tmp_path)
    assert load_model_folder(folder).action.state_change is None
    imagined = make_imagined_environment(config, folder, folder / STARTS, num_envs=2, seed=0)
    shown = imagined.reset()
    assert shown.state.shape == (2, 0)
    output = make_policy(config, folder).act(shown.image, shown.state)
    assert imagined.step(output.actions).valid.all()


def test_a_measured_state_is_predicted_by_a_model_of_tokens_too(config: RunConfig, tmp_path: Path) -> None:
    config = config.with_values(tokenizer=config.tokenizer.with_values(kind="lfq"))
    folder = model_of(record(tmp_path / "bag"), config, tmp_path)
    models = load_model_folder(folder)
    assert models.action.state_change is not None and models.action.state_change.measured == (0, 1, 2, 3, 4, 5)
    imagined = make_imagined_environment(config, folder, folder / STARTS, num_envs=2, seed=0)
    before = imagined.reset().state
    assert (imagined.step(np.full((2, 6), 0.5, np.float32)).observation.state != before).all()


def test_a_policy_scales_measured_states_by_what_was_recorded(config: RunConfig, tmp_path: Path) -> None:
    folder = model_of(record(tmp_path / "bag"), config, tmp_path)
    policy, recorded = make_policy(config, folder), load_model_folder(folder).action.condition
    torch.testing.assert_close(policy.state_shift_S, recorded.state_mean)
    torch.testing.assert_close(policy.state_scale_S, recorded.state_scale)
    assert 0.3 < float(policy.state_scale_S.min()) < float(policy.state_scale_S.max()) < 1.5


def test_where_instructions_differ_goals_are_imagined_by_those_of_the_recordings(
    config: RunConfig, tmp_path: Path
) -> None:
    bag = record(tmp_path / "bag", instructions=("touch the post", "reach the post"))
    folder = model_of(bag, config, tmp_path)
    models = load_model_folder(folder)
    assert models.text is not None
    assert models.text.condition.vocabulary == ("post", "reach", "the", "touch")
    heldout = read_world_manifest(folder)["heldout"]
    assert heldout["goal_episodes"] > 0 and heldout["goal_left_out"] == 0 and heldout["goal_perceptual_copy"] > 0
    rewarded = config.with_values(reward=config.reward.with_values(dense_weight=1.0))
    names = [row.name for row in report_when_made(read_world_manifest(folder), rewarded).criteria]
    assert "imagined goal of touch_the_post: perceptual error / first frame" in names
    imagined = make_imagined_environment(rewarded, folder, folder / STARTS, num_envs=2, seed=0)
    imagined.reset()
    goals = imagined.goals()
    assert goals is not None and goals[0].shape == (2, 72, 96, 3)


def test_goals_that_the_reward_asks_for_need_an_instruction_that_can_be_read(config: RunConfig, tmp_path: Path) -> None:
    bag = record(tmp_path / "bag", instructions=("touch the post " * 5, "touch it"))
    rewarded = config.with_values(reward=config.reward.with_values(dense_weight=1.0))
    with pytest.raises(ConfigError, match=r"imagined goals, but instruction 'touch .* has 15 words, and 1 to 12"):
        model_of(bag, rewarded, tmp_path)
    assert not (tmp_path / "metrics.jsonl").exists()  # nothing was trained before
    assert load_model_folder(model_of(bag, config, tmp_path)).text is None


def mixed() -> EnvironmentSpec:
    """Three commanded values before a measured one."""
    spec = own_environment.SPEC
    return replace(
        spec, action_names=spec.action_names[:3], action_units=("m",) * 3, action_scale=(0.1,) * 3,
        state_names=("target_x", "target_y", "target_z", "force"), state_units=("m", "m", "m", "N"),
        state_low=(0.0, 0.0, 0.0, -9.0), state_high=(1.0, 1.0, 0.05, 9.0),
    )


def test_commanded_values_follow_the_action_inside_their_box_and_measured_ones_stay() -> None:
    spec = mixed()
    assert spec.measured == (3,)
    move = CommandedMove(spec, torch.device("cpu"))
    moved = move(torch.tensor([[0.5, 0.5, 0.0, 2.0]]), torch.ones(1, 3))
    torch.testing.assert_close(moved, torch.tensor([[0.6, 0.6, 0.05, 2.0]]), atol=1e-6, rtol=0)


def test_the_device_program_moves_a_mixed_state_as_the_imagined_environment_does(
    config: RunConfig, tmp_path: Path
) -> None:
    spec = mixed()
    tokenizer = Tokenizer(config.tokenizer, spec.height, spec.width, 0)
    action = ActionModel(
        config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim, action_dim=3,
        state_dim=4, num_tasks=1, num_positions=0, measured=spec.measured,
    )
    folder = save_model_folder(
        tmp_path, tokenizer, action, None, config, spec=spec, tasks=(spec.task,), story={},
    )
    pictures = numpy_stream(0, "pictures").integers(0, 256, (3, spec.height, spec.width, 3), np.uint8)
    starts = pictures, np.array([[0.5, 0.5, 0.02, 1.0]] * 3, np.float32)
    env = ImaginedEnvironment(load_model_folder(folder), spec, starts, config.reward, num_envs=2, seed=0)
    device = DeviceEnvironment.beside(env)
    env.reset()
    with torch.inference_mode():
        device.reset(torch.ones(2, dtype=torch.bool), env.episodes.starts_N)
        for step in range(3):
            actions = numpy_stream(step, "actions").uniform(-1, 1, (2, 3)).astype(np.float32)
            states = env.step(actions).observation.state
            device.step(torch.from_numpy(actions))
            np.testing.assert_allclose(device.states_NP.numpy(), states, atol=1e-6)
    assert (states[:, 3] != 1).all() and (states[:, :3] != 0.5).any()


def test_two_valued_actions_are_named_as_in_the_recording(config: RunConfig, tmp_path: Path) -> None:
    folder = model_of(record(tmp_path / "bag", **NO_STATE), config, tmp_path)
    shown = make_imagined_environment(config, folder, folder / STARTS, num_envs=2, seed=0).reset()
    last = read_world_manifest(folder)["spec"]["action_names"][-1]

    def policy(name: str) -> ImagePolicy:
        return make_policy(config.with_values(policy=config.policy.with_values(two_valued_actions=(name,))), folder)

    assert (np.abs(policy(last).act(shown.image, shown.state).actions[:, -1]) == 1).all()
    with pytest.raises(ValueError, match=rf"two_valued_actions names grip; the actions are .*{last}"):
        policy("grip")
