"""The world model behind the Environment interface, and its folder on disk. Untrained weights: only the rules count."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from recording_samples import make_spec
from safetensors.torch import load_file, save_file

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.device import DeviceError
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.specs import SOURCE_IMAGINED, EnvironmentSpec
from wm_nodes.core.tool_control import next_state
from wm_nodes.core.types import FloatArray, StepResult
from wm_nodes.world_model import (
    ActionModel,
    DeviceEnvironment,
    ImaginedEnvironment,
    TextModel,
    Tokenizer,
    WorldModels,
    load_model_folder,
    load_starts,
    save_model_folder,
)
from wm_nodes.world_model.imagined_episodes import put_where
from wm_nodes.world_model.parts import PART

NUM_ENVS, NUM_STARTS = 3, 5
TASKS = ("push_cube", "reach")


def config_of(**reward: float) -> RunConfig:
    overrides = {"tokenizer.width": 16, "tokenizer.depth": 1, "tokenizer.latent_dim": 6, "world_model.width": 24,
                 "world_model.depth": 2, "world_model.num_heads": 2, "reward.success_threshold": 1.0}
    return load_config("base", overrides | {f"reward.{key}": value for key, value in reward.items()})


def make_folder(folder: Path) -> Path:
    config, spec = config_of(), spec_of()
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer, spec.height, spec.width)
    sizes = {"num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": len(TASKS)}
    action = ActionModel(config.world_model, action_dim=3, state_dim=3, **sizes)
    text = TextModel(config.world_model, vocabulary=("push", "cube"), **sizes)
    torch.nn.init.normal_(action.change.weight, std=0.2)
    return save_model_folder(folder, tokenizer, action, text, config, spec=spec, tasks=TASKS, story={"data": "none"})


def spec_of() -> EnvironmentSpec:
    commanded = ("target_x", "target_y", "target_z")
    return make_spec(NUM_ENVS, 32, 64, instruction="push cube", max_episode_steps=5, state_names=commanded)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> WorldModels:
    return load_model_folder(make_folder(tmp_path_factory.mktemp("world") / "model"))


def starts() -> tuple[np.ndarray, FloatArray]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (NUM_STARTS, 32, 64, 3), dtype=np.uint8)
    return images, rng.uniform(0.5, 0.7, (NUM_STARTS, 3)).astype(np.float32)


def make(
    models: WorldModels, seed: int = 0, num_envs: int = NUM_ENVS, exact: bool = False, picture_noise: float = 0.0,
    second: WorldModels | None = None, **reward: float,
) -> ImaginedEnvironment:
    return ImaginedEnvironment(
        models, spec_of(), starts(), config_of(**reward).reward, num_envs=num_envs, seed=seed, with_goals=False,
        exact=exact, picture_noise=picture_noise, second=second,
    )


def actions(step: int) -> FloatArray:
    return np.random.default_rng(step).uniform(-1, 1, (NUM_ENVS, 3)).astype(np.float32)


def assert_same(first: StepResult, second: StepResult, rows: slice = slice(None)) -> None:
    np.testing.assert_array_equal(first.observation.image[rows], second.observation.image[rows])
    np.testing.assert_array_equal(first.observation.state[rows], second.observation.state[rows])
    np.testing.assert_array_equal(first.success_probability[rows], second.success_probability[rows])
    np.testing.assert_array_equal(first.uncertainty[rows], second.uncertainty[rows])


def test_equal_seeds_give_bit_identical_episodes(models: WorldModels) -> None:
    first, second = make(models), make(models)
    seeds = np.arange(NUM_ENVS, dtype=np.uint64)
    np.testing.assert_array_equal(first.reset(seeds=seeds).image, second.reset(seeds=seeds).image)
    for step in range(4):
        assert_same(first.step(actions(step)), second.step(actions(step)))


def test_picture_noise_is_shown_and_not_imagined_on(models: WorldModels) -> None:
    clean, noisy, again = make(models), make(models, picture_noise=0.5), make(models, picture_noise=0.5)
    seeds = np.full(NUM_ENVS, 7, np.uint64)
    for env in (clean, noisy, again):
        env.reset(seeds=seeds)
    for step in range(3):
        same = np.repeat(actions(step)[:1], NUM_ENVS, 0)
        shown, hidden, repeated = (env.step(same) for env in (clean, noisy, again))
        assert_same(hidden, repeated)
        np.testing.assert_array_equal(shown.success_probability, hidden.success_probability)
        np.testing.assert_array_equal(shown.observation.state, hidden.observation.state)
        frames = hidden.observation.image
        assert (frames != shown.observation.image).any((1, 2, 3)).all() and (frames[0] != frames[1]).any()
    with pytest.raises(ValueError, match=r"device rollouts know no imagined_environment\.picture_noise"):
        DeviceEnvironment.beside(noisy)


def test_of_two_models_the_lower_done_signal_counts_and_their_difference_is_disagreement(
    models: WorldModels, tmp_path: Path
) -> None:
    other = replace(models, action=copy.deepcopy(models.action))
    torch.nn.init.normal_(other.action.change.weight, std=0.4)
    alone, rival, both = make(models), make(other), make(models, second=other)
    seeds = np.arange(NUM_ENVS, dtype=np.uint64)
    for env in (alone, rival, both):
        env.reset(seeds=seeds)
    for step in range(3):
        one, two, found = (env.step(actions(step)) for env in (alone, rival, both))
        np.testing.assert_array_equal(found.observation.image, one.observation.image)
        signals = np.stack([one.success_probability, two.success_probability])
        np.testing.assert_array_equal(found.success_probability, signals.min(0))
        spreads = np.stack([one.uncertainty, two.uncertainty, np.ptp(signals, 0)])
        np.testing.assert_array_equal(found.uncertainty, spreads.max(0))
    assert np.ptp(signals, 0).max() > 0
    with pytest.raises(ValueError, match="second_model has another tokenizer or other tasks"):
        make(models, second=replace(other, manifest={"sha256": {"tokenizer": "0" * 64}}))


def test_one_environment_reset_later_lives_the_same_episode_bit_for_bit(models: WorldModels) -> None:
    early, late = make(models), make(models)
    seeds = np.full(NUM_ENVS, 7, np.uint64)
    early.reset(seeds=seeds)
    late.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    late.step(actions(0))
    late.reset(mask=np.array([False, True, False]), seeds=seeds)
    for step in range(3):
        assert_same(early.step(actions(step)), late.step(actions(step)), slice(1, 2))


def test_environments_in_different_parts_of_a_batch_live_the_episodes_of_one_part(models: WorldModels) -> None:
    count = PART + NUM_ENVS
    many, few = make(models, num_envs=count, exact=True), make(models, exact=True)
    rows = np.arange(count) % NUM_ENVS
    many.reset(seeds=rows.astype(np.uint64))
    few.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    for step in range(4):
        if step == 2:  # a reset of some environments of both parts
            many.reset(mask=rows == 1, seeds=np.full(count, 7, np.uint64))
            few.reset(mask=np.arange(NUM_ENVS) == 1, seeds=np.full(NUM_ENVS, 7, np.uint64))
        together, alone = many.step(actions(step)[rows]), few.step(actions(step))
        difference = together.observation.image.astype(int) - alone.observation.image[rows]
        assert np.abs(difference).max() <= 2  # batches of other sizes may round otherwise
        np.testing.assert_allclose(together.success_probability, alone.success_probability[rows], atol=1e-5)


def test_a_reset_begins_at_a_real_frame_chosen_by_the_seed(models: WorldModels) -> None:
    env, (images, states) = make(models), starts()
    observation = env.reset(seeds=np.array([1, 1, 2], np.uint64))
    np.testing.assert_array_equal(observation.image[0], observation.image[1])
    matches = (images == observation.image[0]).all((1, 2, 3))
    assert matches.sum() == 1
    np.testing.assert_array_equal(observation.state[0], states[matches][0])


def test_the_tool_position_follows_the_controller_exactly(models: WorldModels) -> None:
    env = make(models)
    before = env.reset().state
    after = env.step(actions(0)).observation.state
    np.testing.assert_array_equal(after, next_state(before, actions(0), env.spec))


def test_an_episode_is_truncated_at_the_step_limit_and_then_stays_put(models: WorldModels) -> None:
    env = make(models)
    env.reset()
    results = [env.step(actions(step)) for step in range(env.spec.max_episode_steps + 1)]
    assert not np.concatenate([result.truncated for result in results[:-2]]).any()
    assert results[-2].truncated.all()
    assert not results[-2].terminated.any()
    assert not results[-1].valid.any()
    np.testing.assert_array_equal(results[-1].observation.image, results[-2].observation.image)
    np.testing.assert_array_equal(results[-1].observation.episode_step, [env.spec.max_episode_steps] * NUM_ENVS)


def test_a_done_signal_above_the_threshold_terminates_and_never_also_truncates(models: WorldModels) -> None:
    env = make(models, success_threshold=0.0)
    env.reset()
    result = env.step(actions(0))
    assert result.terminated.all()
    assert not result.truncated.any()


def test_too_much_disagreement_of_the_done_heads_truncates(models: WorldModels) -> None:
    for threshold in (0.0, 1.0):  # crossed in the same step, and not: neither is a success
        env = make(models, uncertainty_limit=1e-9, success_threshold=threshold)
        env.reset()
        result = env.step(actions(0))
        assert result.truncated.all() and not result.terminated.any()


def test_as_many_episodes_as_starts_begin_at_each_once(models: WorldModels) -> None:
    env = make(models)
    seeds, begun = np.arange(1_500_000, 1_500_000 + NUM_STARTS, dtype=np.uint64), list[int]()
    for first in range(NUM_STARTS):
        env.reset(None, np.roll(seeds, first)[:NUM_ENVS])
        begun.append(int(env.episodes.starts_N[0]))
    assert sorted(begun) == [*range(NUM_STARTS)]


def test_the_spec_says_imagined_and_names_the_model(models: WorldModels) -> None:
    spec = make(models).spec
    assert spec.source == SOURCE_IMAGINED
    assert spec.world_model_sha256 == models.sha256


def test_goals_belong_to_the_start_of_each_environment(models: WorldModels) -> None:
    env = ImaginedEnvironment(models, spec_of(), starts(), config_of().reward, num_envs=NUM_ENVS)
    env.reset(seeds=np.array([1, 1, 2], np.uint64))
    goals = env.goals()
    assert goals is not None
    frames, found = goals
    assert frames.shape == (NUM_ENVS, 32, 64, 3)
    assert found.shape == (NUM_ENVS,)
    np.testing.assert_array_equal(frames[0], frames[1])


def test_a_loaded_folder_predicts_what_was_saved_up_to_half_precision(models: WorldModels, tmp_path: Path) -> None:
    again = save_model_folder(
        tmp_path / "copy", models.tokenizer, models.action, models.text, config_of(), spec=models.spec,
        tasks=models.tasks, story={},
    )
    assert load_model_folder(again).sha256 == models.sha256


def test_states_of_any_unit_are_scaled_by_a_loaded_folder_as_in_training(models: WorldModels, tmp_path: Path) -> None:
    """Encoder ticks: 70,000 is beyond float16, and 12,345 to 12,346 are one number in it."""
    action = copy.deepcopy(models.action)
    action.condition.fit_states(torch.tensor([[70_000.0, 12_345.0, 0.0], [70_010.0, 12_346.0, 1.0]]))
    folder = save_model_folder(
        tmp_path / "ticks", models.tokenizer, action, None, config_of(), spec=models.spec, tasks=models.tasks, story={}
    )
    loaded, seen = load_model_folder(folder).action.condition, torch.tensor([[[70_002.0, 12_345.5, 0.5]]])
    actions = torch.zeros(1, 1, 3)
    torch.testing.assert_close(loaded(actions, seen, seen), action.condition(actions, seen, seen), atol=0.05, rtol=0.05)


def test_a_missing_damaged_or_exchanged_file_is_one_clear_error(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "model")
    weights = folder / "action_model.safetensors"
    data = weights.read_bytes()
    weights.write_bytes(data[:-10])
    with pytest.raises(ModelFolderError, match="sha256 differs"):
        load_model_folder(folder)
    weights.unlink()
    with pytest.raises(ModelFolderError, match="missing"):
        load_model_folder(folder)
    with pytest.raises(ModelFolderError, match="holds no"):
        load_model_folder(tmp_path)


def test_weights_of_another_architecture_are_one_clear_error(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "model")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["world_model"]["width"] = 32
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ModelFolderError, match="another architecture"):
        load_model_folder(folder)


def test_a_task_the_model_does_not_know_is_refused(models: WorldModels) -> None:
    with pytest.raises(ModelFolderError, match="push_cube, reach"):
        models.task_index("pull_cube")


def test_starts_are_read_from_a_file_and_an_empty_or_foreign_one_is_refused(tmp_path: Path) -> None:
    images, states = (torch.from_numpy(array) for array in starts())
    save_file({"images": images, "states": states}, tmp_path / "starts.safetensors")
    assert load_starts(tmp_path / "starts.safetensors")[0].shape == (NUM_STARTS, 32, 64, 3)
    save_file({"images": images[:0]}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="no starts file"):
        load_starts(tmp_path / "foreign.safetensors")


def test_files_hold_half_precision(tmp_path: Path) -> None:
    tensors = load_file(make_folder(tmp_path / "model") / "tokenizer.safetensors")
    exact = {name for name, tensor in tensors.items() if tensor.dtype == torch.float32}
    assert exact == {"background", "probe_mean", "probe_std"}, "what scales numbers of any unit"
    assert {tensor.dtype for name, tensor in tensors.items() if name not in exact} == {torch.float16}


def test_too_little_memory_names_the_number_of_environments(
    models: WorldModels, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(models)
    env.reset()

    def full(*arguments: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.\nTried to allocate 20.00 GiB.")

    monkeypatch.setattr(type(models.action), "advance", full)
    with pytest.raises(DeviceError, match=r"^the memory of cpu is too small; lower ppo\.num_envs from 3 to 1, or take"):
        env.step(actions(0))


@pytest.mark.parametrize(
    ("shape", "kind"),
    [((3, 5, 7, 3), torch.uint8), ((3, 8, 4, 3), torch.uint8), ((3, 3), torch.float32), ((3, 0), torch.float32),
     ((3, 4, 5), torch.bfloat16)],
)
def test_rows_are_put_in_place_where_the_mask_says_and_to_the_bit(shape: tuple[int, ...], kind: torch.dtype) -> None:
    mask, (before, new) = torch.tensor([True, False, True]), (50 * torch.randn(2, *shape)).to(kind)
    now = before.clone()
    memory = now.data_ptr()
    put_where(mask, now, new.transpose(1, -1).contiguous().transpose(1, -1))
    wanted = [new[0].tolist(), before[1].tolist(), new[2].tolist()]
    assert now.tolist() == wanted and now.data_ptr() == memory
