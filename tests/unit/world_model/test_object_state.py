"""Where things are, as part of the state: the model predicts it, its done heads and policies see it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.differences import NEAR_M, Differences
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.world_model import (
    ActionModel,
    DeviceEnvironment,
    ImaginedEnvironment,
    Tokenizer,
    load_model_folder,
    save_model_folder,
)
from wm_nodes.world_model.state_change import StateChange

SETTINGS = {
    "task": "push", "simulation.object_state": "truth", "policy.inputs": "state", "tokenizer.width": 16,
    "tokenizer.latent_dim": 8, "world_model.width": 16, "world_model.num_heads": 2, "world_model.depth": 1,
    "world_model.object_reader_iterations": 1,
}


@pytest.fixture
def config() -> RunConfig:
    return load_config("base", SETTINGS)


def model_of(config: RunConfig, spec: EnvironmentSpec, tokenizer: Tokenizer) -> ActionModel:
    return ActionModel(
        config.world_model, num_tokens=tokenizer.num_tokens, latent_dim=tokenizer.latent_dim,
        action_dim=spec.action_dim, state_dim=spec.state_dim, num_tasks=1, num_positions=tokenizer.num_positions,
        measured=spec.measured, differences=spec.differences,
    )


def folder_of(config: RunConfig, path: Path) -> Path:
    spec = configured_spec(config)
    tokenizer = Tokenizer(config.tokenizer, spec.height, spec.width)
    action = model_of(config, spec, tokenizer)
    return save_model_folder(path, tokenizer, action, None, config, spec=spec, tasks=("push",), story={})


def test_differences_are_between_lengths_along_one_axis_and_no_others(config: RunConfig) -> None:
    spec = configured_spec(config)
    named = {(spec.state_names[i], spec.state_names[j]) for i, j in spec.differences}
    assert ("tool_target_x", "object_x") in named and ("object_z",) not in named
    assert all(a[-1] == b[-1] and "rx" not in (a[-2:], b[-2:]) for a, b in named)
    plain = configured_spec(config.with_values(simulation=config.simulation.with_values(object_state="")))
    assert plain.differences == () and plain.measured == ()


def test_a_difference_is_seen_in_multiples_of_what_is_near() -> None:
    seen = Differences(3, ((0, 2),))(torch.zeros(1, 3), torch.tensor([[0.5, 7.0, 0.3]]))
    torch.testing.assert_close(seen, torch.tensor([[0.0, 0.0, 0.0, 0.2 / NEAR_M]]))


def test_what_nothing_touches_hardly_drifts() -> None:
    """A tool pushes small things on a table along x: what it does not touch stays, better than in a plain network."""
    stream, errors = numpy_stream(0, "pushes"), []
    tool, thing = torch.from_numpy(stream.uniform(-0.3, 0.3, (2, 1024, 2)).astype(np.float32))
    thing[::2] = tool[::2] + 0.2 * thing[::2]
    way = torch.tensor([0.03, 0.0])
    touched = ((thing - tool - way / 2).abs() < 0.03).all(1, keepdim=True)
    states, after = torch.cat((tool, thing), 1), torch.cat((tool + way, thing + touched * way), 1)
    latents, actions = torch.zeros(1024, 1, 1), torch.ones(1024, 1)
    for differences in ((), ((0, 2), (1, 3))):
        torch.manual_seed(0)
        change = StateChange(1, 4, 1, (2, 3), differences)
        change.fit_scale(states, after - states)
        optimizer = torch.optim.Adam(change.parameters(), 3e-3)
        for _ in range(100):
            found = change(latents, actions, states)
            loss = F.huber_loss(found, change.wanted(states, after), delta=change.delta)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        with torch.no_grad():
            there = change.next_states(latents, actions, states, after)
        errors.append(float((there - after)[~touched[:, 0], 2].abs().mean()))
    assert errors[1] < 0.5 * errors[0]


def test_done_heads_see_the_state_and_the_model_moves_what_is_measured(config: RunConfig, tmp_path: Path) -> None:
    models, spec = load_model_folder(folder_of(config, tmp_path)), configured_spec(config)
    images = numpy_stream(0, "pictures").integers(0, 256, (2, spec.height, spec.width, 3), np.uint8)
    states = np.full((2, spec.state_dim), 0.5, np.float32)
    states[1, spec.state_names.index("object_x")] += 0.2
    signals = []
    for rows in (states, states[::-1].copy()):
        env = ImaginedEnvironment(models, spec, (images[:1].repeat(2, 0), rows), config.reward, num_envs=2, seed=0)
        env.reset(seeds=np.array([0, 1], np.uint64))
        begun = env.current().state
        made = env.step(np.zeros((2, spec.action_dim), np.float32))
        signals.append(made.success_probability)
        after = made.observation.state
        assert (after[:, spec.measured] != begun[:, spec.measured]).any()
        np.testing.assert_array_equal(after[:, : spec.commanded_dim - 1], begun[:, : spec.commanded_dim - 1])
    assert not np.array_equal(*signals) or signals[0][0] != signals[0][1]
    device = DeviceEnvironment.beside(env)
    with torch.inference_mode():
        device.reset(torch.ones(2, dtype=torch.bool), env.episodes.starts_N)
        assert device.encode("state").shape == (2, 0)


def test_a_policy_of_the_state_sees_nothing_of_the_picture(config: RunConfig, tmp_path: Path) -> None:
    folder, spec = folder_of(config, tmp_path), configured_spec(config)
    policy = make_policy(config, folder)
    state = numpy_stream(0, "state").uniform(-1, 1, (2, spec.state_dim)).astype(np.float32)
    pictures = numpy_stream(0, "pictures").integers(0, 256, (2, 2, spec.height, spec.width, 3), np.uint8)
    first, second = (policy.act(images, state).actions for images in pictures)
    np.testing.assert_array_equal(first, second)
    moved = state.copy()
    moved[:, spec.state_names.index("object_x")] += 0.05
    assert not np.array_equal(policy.act(pictures[0], moved).actions, first)
    np.testing.assert_array_equal(policy.clone().act(pictures[0], state).actions, first)


def test_a_policy_that_would_see_the_commanded_tool_alone_is_refused(config: RunConfig, tmp_path: Path) -> None:
    plain = config.with_values(simulation=config.simulation.with_values(object_state=""))
    with pytest.raises(ValueError, match="take a model with an object reader"):
        make_policy(plain, folder_of(plain, tmp_path))


def test_what_does_not_matter_in_a_task_is_not_seen_by_its_policies(config: RunConfig, tmp_path: Path) -> None:
    folder, spec = folder_of(config, tmp_path), configured_spec(config)
    policy, image = make_policy(config, folder), np.zeros((1, spec.height, spec.width, 3), np.uint8)
    state = numpy_stream(0, "state").uniform(-1, 1, (1, spec.state_dim)).astype(np.float32)
    ignored = [i for i, name in enumerate(spec.state_names) if name in config.policy.ignored_state]
    assert {spec.state_names[i].rsplit("_", 1)[0] for i in ignored} == {"container", "goal", "object_start"}
    other = state.copy()
    other[:, ignored] += 1
    np.testing.assert_array_equal(policy.act(image, other).actions, policy.act(image, state).actions)
    np.testing.assert_array_equal(policy.clone().act(image, other).actions, policy.act(image, state).actions)
    carrying = {task: load_config("base", {**SETTINGS, "task": task}).policy for task in ("pick_place", "move_to_aim")}
    assert "container_x" not in carrying["pick_place"].ignored_state
    assert "goal_x" not in carrying["move_to_aim"].ignored_state


def test_a_task_that_says_of_nothing_where_it_is_has_no_such_state(config: RunConfig) -> None:
    cube = load_config("base", {"task": "push_cube", "simulation.object_state": "truth"})
    with pytest.raises(ValueError, match="task push_cube says of nothing where it is; leave it empty"):
        configured_spec(cube)
    assert replace(configured_spec(config), num_envs=3).measured == tuple(range(7, 16))
