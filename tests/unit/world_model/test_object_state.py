"""Where things are, as part of the state: a model of states predicts it and the done signal, policies see it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.differences import NEAR_M, Differences
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.device_rollout import DeviceCollector, make_collector, unseen_pictures_left_out
from wm_nodes.policy_rl.factories import make_endogenous_reward, make_policy
from wm_nodes.policy_rl.model_refresh import check_refreshable
from wm_nodes.policy_rl.rollouts import TensorRollout, collect_rollout
from wm_nodes.policy_rl.validation.evaluation import evaluate
from wm_nodes.world_model import (
    ActionModel,
    DeviceEnvironment,
    ImaginedEnvironment,
    Tokenizer,
    WorldModels,
    load_model_folder,
    save_model_folder,
)
from wm_nodes.world_model.dynamics import done_signal
from wm_nodes.world_model.positions import position_names
from wm_nodes.world_model.state_model import StateModel
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.training import state_model as training
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes
from wm_nodes.world_model.training.state_model import train_state_model
from wm_nodes.world_model.validation.open_loop import places_of_states

SETTINGS = {
    "task": "push", "simulation.object_state": "truth", "policy.inputs": "state", "tokenizer.width": 16,
    "tokenizer.latent_dim": 8, "world_model.width": 16, "world_model.num_heads": 2, "world_model.depth": 1,
    "world_model.object_reader_iterations": 1, "world_model.state_model_iterations": 1,
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


def test_a_model_of_states_learns_a_push_and_its_success(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tool pushes small things on a table along x; those that end beyond a line have won."""
    stream, way, steps = numpy_stream(0, "pushes"), torch.tensor([0.03, 0.0]), 6
    tool, thing = torch.from_numpy(stream.uniform(-0.3, 0.3, (2, 512, 2)).astype(np.float32))
    thing[::2] = tool[::2] + torch.tensor([0.08, 0.0]) + 0.1 * thing[::2]
    frames = [torch.cat((tool, thing), 1)]
    for _ in range(steps):
        touched = ((thing - tool - way / 2).abs() < 0.03).all(1, keepdim=True)
        tool, thing = tool + way, thing + touched * way
        frames.append(torch.cat((tool, thing), 1))
    states = torch.stack(frames, 1)
    moved = (states[:, -1, 2] - states[:, 0, 2]).abs() > 0.01
    won = states[..., 2:3] > 0.1
    data = LatentEpisodes(
        torch.zeros(512, 1, 1, 1, 3), torch.zeros(512, steps + 1, 1, 1), torch.zeros(1), states,
        torch.zeros(512, steps, 1), won, torch.ones(512, 1), torch.zeros(512, steps + 1, 0),
        torch.ones(512, steps, dtype=torch.bool),
    )
    torch.manual_seed(0)
    model = StateModel(4, (2, 3), ((0, 2), (1, 3)), num_tasks=1, num_heads=2)
    model.fit_scale(states[:, :-1].flatten(0, 1), (states[:, 1:] - states[:, :-1]).flatten(0, 1))
    monkeypatch.setattr(training, "READING_NOISE_M", 0.0)
    metrics = train_state_model(model, data, 400, 0, None)
    assert metrics["loss"] == pytest.approx(metrics["change"] + metrics["done"])
    earlier = now = states[:, 0]
    with torch.no_grad():
        for t in range(steps):
            earlier, now = now, model.next_states(now, earlier, states[:, t + 1])
        signal, _ = done_signal(model.done_logits(now, earlier))
    errors = (now - states[:, -1])[:, 2].abs()
    travelled = (states[:, -1] - states[:, 0])[moved, 2].mean()
    assert errors[~moved].mean() < 0.005 and errors[moved].mean() < 0.25 * travelled
    assert ((signal > 0.5) == won[:, -1]).float().mean() > 0.9


def test_the_done_signal_sees_whether_things_still_move_but_not_how_the_tool_came() -> None:
    torch.manual_seed(0)
    model, now = StateModel(4, (2, 3), ((0, 2), (1, 3)), num_tasks=1, num_heads=2), torch.zeros(1, 4)
    at_rest, fell, tool_moved = (model.done_logits(now, now + torch.tensor([change])) for change in (
        [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.5], [0.5, 0.0, 0.0, 0.0]))
    assert not torch.equal(fell, at_rest) and torch.equal(tool_moved, at_rest)


def told_models(config: RunConfig, path: Path) -> tuple[WorldModels, tuple[np.ndarray, np.ndarray]]:
    """A model of states and two starts; its weights are noise, so that done signals differ."""
    spec = configured_spec(config)
    folder = folder_of(config, path)
    models = load_model_folder(folder)
    assert models.action.state_model is not None and models.action.state_change is None
    with torch.no_grad():
        for parameter in models.action.state_model.parameters():
            parameter.add_(0.03 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    images = numpy_stream(0, "pictures").integers(0, 256, (2, spec.height, spec.width, 3), np.uint8)
    states = np.full((2, spec.state_dim), 0.5, np.float32)
    states[1, spec.state_names.index("object_x")] += 0.2
    return models, (images, states)


def test_the_model_moves_what_is_measured_and_its_signal_is_of_the_state_alone(
    config: RunConfig, tmp_path: Path
) -> None:
    models, (images, states) = told_models(config, tmp_path)
    spec, made = configured_spec(config), []
    for pictures in (images, images[::-1].copy()):
        env = ImaginedEnvironment(models, spec, (pictures, states), config.reward, num_envs=2, seed=0)
        env.reset(seeds=np.array([0, 1], np.uint64))
        begun = env.current().state
        made.append(env.step(np.zeros((2, spec.action_dim), np.float32)))
        after = made[-1].observation.state
        assert (after[:, spec.measured] != begun[:, spec.measured]).any()
        np.testing.assert_array_equal(after[:, : spec.commanded_dim - 1], begun[:, : spec.commanded_dim - 1])
    np.testing.assert_array_equal(made[0].success_probability, made[1].success_probability)
    assert len(set(made[0].success_probability.tolist())) == len({*env.episodes.starts_N.tolist()})
    assert not np.array_equal(made[0].observation.image, made[1].observation.image)


def test_without_pictures_everything_else_is_the_same(config: RunConfig, tmp_path: Path) -> None:
    models, starts = told_models(config, tmp_path)
    spec = configured_spec(config)
    env = ImaginedEnvironment(models, spec, starts, config.reward, num_envs=2, seed=0)
    policy = make_policy(config, tmp_path)
    reward = make_endogenous_reward(config, tmp_path)
    dark = make_collector(env, policy, reward)(4, 0, 1)
    assert isinstance(dark, TensorRollout) and dark.images is None
    with pytest.raises(ValueError, match="this rollout has no pictures"):
        dark.pictures()
    seen = collect_rollout(env, policy, reward, 4, 0, 1)
    for name in ("states", "actions", "logprobs", "rewards", "valid"):
        ours, theirs = getattr(dark, f"{name}_TN").numpy(), getattr(seen, f"{name}_TN")
        np.testing.assert_array_equal(ours, theirs, name)
    assert (seen.images_TN[1:] != seen.images_TN[:-1]).any()


def test_a_policy_is_measured_without_the_pictures_that_it_does_not_see(config: RunConfig, tmp_path: Path) -> None:
    models, starts = told_models(config, tmp_path)
    env = ImaginedEnvironment(models, configured_spec(config), starts, config.reward, num_envs=2, seed=0)
    policy = make_policy(config, tmp_path)
    shown = evaluate(policy, env, 4, 0)
    with unseen_pictures_left_out(env, policy):
        assert not env.episodes.pictures
        hidden = evaluate(policy, env, 4, 0)
    assert env.episodes.pictures
    np.testing.assert_array_equal(hidden.success, shown.success)
    np.testing.assert_array_equal(hidden.length, shown.length)
    looking = make_policy(config.with_values(policy=config.policy.with_values(inputs="latents")), tmp_path)
    with unseen_pictures_left_out(env, looking):
        assert env.episodes.pictures


def test_who_looks_has_pictures(config: RunConfig, tmp_path: Path) -> None:
    models, starts = told_models(config, tmp_path)
    env = DeviceEnvironment(models, configured_spec(config), starts, config.reward, num_envs=2, with_goals=False)
    reward = make_endogenous_reward(config, tmp_path)
    looking = make_policy(config.with_values(policy=config.policy.with_values(inputs="latents")), tmp_path)
    assert DeviceCollector(env, looking, reward).collect(2, 0, 1).images is not None
    assert DeviceCollector(env, make_policy(config, tmp_path), reward).collect(2, 0, 1).images is None


def test_a_model_of_states_needs_a_state_that_says_something(config: RunConfig) -> None:
    plain = config.with_values(simulation=config.simulation.with_values(object_state=""))
    tokenizer = Tokenizer(config.tokenizer, 64, 128)
    with pytest.raises(ValueError, match=r"all of this one is commanded; set simulation\.object_state"):
        model_of(plain, configured_spec(plain), tokenizer)
    with pytest.raises(ValueError, match=r"goes with tokenizer\.kind continuous alone"):
        TokenActionModel(config.world_model, num_tokens=4, latent_dim=8, action_dim=1, state_dim=2, num_tasks=1)


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


def test_what_would_do_nothing_where_places_are_in_the_state_is_refused(config: RunConfig, tmp_path: Path) -> None:
    folder = folder_of(config, tmp_path)
    for section, name in (("policy", "dropout"), ("imagined_environment", "picture_noise")):
        asked = config.with_values(**{section: getattr(config, section).with_values(**{name: 0.1})})
        with pytest.raises(ValueError, match=rf"{section}\.{name} is 0\.1, and a policy with policy\.inputs state"):
            make_policy(asked, folder)
    models = load_model_folder(folder)
    with pytest.raises(ValueError, match=r"second_model predicts pictures, and push has places in its state"):
        DeviceEnvironment(
            models, configured_spec(config), told_models(config, tmp_path / "told")[1], config.reward, num_envs=2,
            with_goals=False, second=models,
        )
    with pytest.raises(ValueError, match=r"predicts places by a model of states, which rounds do not refresh; set"):
        check_refreshable(folder)


def test_a_policy_that_would_see_the_commanded_tool_alone_is_refused(config: RunConfig, tmp_path: Path) -> None:
    plain = config.with_values(
        simulation=config.simulation.with_values(object_state=""),
        world_model=config.world_model.with_values(state_model_iterations=0),
    )
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


def test_places_that_states_say_are_in_the_frame_of_the_truth() -> None:
    names = ("tool_target_x", "tool_target_y", "gripper_target", "object_x", "object_y")
    columns = position_names("push")
    truth = numpy_stream(0, "truth").uniform(-0.3, 0.3, (5, 3, len(columns))).astype(np.float32)
    shift = np.array([0.6, 0.0, 0.0, 0.6, 0.0], np.float32)
    said = [columns.index(name) if name in columns else 0 for name in ("tool_x", "tool_y", "", "object_x", "object_y")]
    places = places_of_states(truth[..., said] + shift, names, "push", truth[:, 0])
    known = [columns.index(name) for name in ("tool_x", "tool_y", "object_x", "object_y")]
    np.testing.assert_allclose(places[..., known], truth[..., known], atol=1e-6)
    assert np.isnan(places[..., columns.index("goal_x")]).all()
