"""The text model with an instruction for every episode: its condition, its training, its goals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from pushing_scene import episode, success
from torch import Tensor
from torch.testing import assert_close

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.world_model import TextModel, Tokenizer, load_model_folder, load_starts
from wm_nodes.world_model.dynamics import ActionModel, Prediction
from wm_nodes.world_model.imagined_environment import imagine_start_goals
from wm_nodes.world_model.text import MAX_WORDS
from wm_nodes.world_model.training.device_rollout import roll_out_on_device
from wm_nodes.world_model.training.dynamics import new_model, roll_out
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes, tokenise_episodes
from wm_nodes.world_model.training.text import golden_rows, row_instructions, train_text_model

TASKS = ("reach", "push_cube")
TEXTS = tuple(get_task(task).instruction for task in TASKS)
MIXED = ["push the red cube forward", "push the cube", "pick up the red cube", "push the red cube forward"]


def config_of(**overrides: object) -> RunConfig:
    small = {
        "tokenizer.width": 32, "tokenizer.depth": 1, "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8,
        "world_model.width": 32, "world_model.depth": 1, "world_model.num_heads": 2, "world_model.batch_size": 8,
        "world_model.learning_rate": 3e-3, "world_model.text_num_iterations": 4,
    }
    return load_config("base", small | {key.replace("__", "."): value for key, value in overrides.items()})


def random_model() -> tuple[TextModel, Tokenizer]:
    """No weight is zero, so that every input matters."""
    config = config_of(world_model__depth=2)
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer, 32, 32).eval()
    words = ("cube", "forward", "pick", "push", "red", "the", "up")
    model = TextModel(config.world_model, num_tokens=16, latent_dim=8, vocabulary=words, num_tasks=1).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model, tokenizer


def one_row_form(
    model: TextModel, latents_BTSD: Tensor, instructions: Sequence[str], caches: object = None
) -> Prediction:
    """What the model computed when a whole batch had one instruction: its tokens, seen by every row."""
    (instruction,) = set(instructions)
    condition, words = model.condition, instruction.split()
    index = torch.tensor([condition.vocabulary.index(word) for word in words])
    tokens = torch.cat((condition.words(index) + condition.position[: len(words)], condition.null))
    return model.predict(latents_BTSD, tokens.expand(*latents_BTSD.shape[:2], -1, -1), caches)  # type: ignore[arg-type]


def test_a_row_among_shorter_and_longer_instructions_is_predicted_as_it_is_alone() -> None:
    model, tokenizer = random_model()
    latents = tokenizer.normalise(torch.randn(1, 3, 16, 8)).expand(len(MIXED), -1, -1, -1)
    together = model(latents, MIXED)
    for row, text in enumerate(MIXED):
        alone = model(latents[:1], [text])
        for name in ("change_BTSD", "positions_BTQ", "done_logits_BTKJ"):
            assert_close(getattr(together, name)[row : row + 1], getattr(alone, name), rtol=1e-4, atol=1e-5)
    change = together.change_BTSD
    assert change[0].equal(change[3])
    assert min((change[0] - change[i]).abs().max() for i in (1, 2)) > 1e-3


def test_rollouts_for_a_device_give_the_mixed_instructions_predictions_and_gradients_of_the_cpu() -> None:
    model, tokenizer = random_model()
    first = tokenizer.normalise(torch.randn(len(MIXED), 1, 16, 8))
    steps, caches = 3, model.trunk.new_caches()
    on_cpu = roll_out(lambda t, latents: model(latents, MIXED, caches), tokenizer, first, steps)
    weights = torch.randn(on_cpu.next_latents.shape)
    (on_cpu.next_latents * weights).sum().backward()
    wanted = model.condition.words.weight.grad
    assert wanted is not None
    model.condition.words.weight.grad = None
    condition, visible = model.condition_of(MIXED, len(MIXED), steps)
    anchors = torch.arange(steps).expand(len(MIXED), -1) == 0
    found, _, _ = roll_out_on_device(
        model, tokenizer, first.expand(-1, steps, -1, -1), anchors, condition, torch.float32, visible
    )
    assert_close(found, on_cpu.next_latents, rtol=1e-3, atol=1e-4)
    (found * weights).sum().backward()
    assert_close(model.condition.words.weight.grad, wanted, rtol=1e-3, atol=1e-3)


def test_an_unknown_word_names_its_instruction_among_many_and_what_is_known() -> None:
    model, _ = random_model()
    with pytest.raises(ValueError, match=r"^instruction 'push the sphere': unknown words sphere; this model knows at "
                                         rf"most {MAX_WORDS} of cube, forward, pick, push, red, the, up$"):
        model.condition([MIXED[0], "push the sphere"])
    assert model.condition([" ".join(["push"] * MAX_WORDS)])[0].shape == (1, MAX_WORDS + 1, 32)


@pytest.mark.parametrize("task", TASKS)
def test_goals_of_the_shipped_model_have_the_bits_of_one_instruction_for_the_whole_batch(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shipped_model(task)
    models, starts = load_model_folder(folder), tuple(a[:4] for a in load_starts(folder / "starts.safetensors"))
    config = load_config("base", {"task": task, "simulation.max_episode_steps": 6})
    spec = simulation_spec(task, config.simulation, 1)
    found = imagine_start_goals(models, starts, spec, config.reward, [spec.instruction] * 4)
    monkeypatch.setattr(TextModel, "forward", one_row_form)
    wanted = imagine_start_goals(models, starts, spec, config.reward)
    assert found is not None and wanted is not None
    for name in ("frames", "lengths", "found"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_the_shipped_model_imagines_each_starts_goal_by_its_own_instruction() -> None:
    folder = shipped_model("push_cube")
    models, starts = load_model_folder(folder), tuple(a[:2] for a in load_starts(folder / "starts.safetensors"))
    config = load_config("base", {"task": "push_cube", "simulation.max_episode_steps": 6})
    spec = simulation_spec("push_cube", config.simulation, 1)
    reach, push = (
        imagine_start_goals(models, starts, replace(spec, instruction=text), config.reward) for text in TEXTS
    )
    mixed = imagine_start_goals(models, starts, spec, config.reward, TEXTS)
    assert mixed is not None and reach is not None and push is not None

    def difference(one: np.ndarray, other: np.ndarray) -> int:
        return int(np.abs(one.astype(int) - other).max())

    assert difference(mixed.goals[0], reach.goals[0]) <= 1 and difference(mixed.goals[1], push.goals[1]) <= 1
    assert difference(mixed.goals[0], push.goals[0]) > 50


def golden_episodes(count: int = 8) -> EpisodeArrays:
    """Demonstrations of the square scene, in turn for one task and the other, whose success is that of both."""
    made = [replace(episode(i), instruction=TEXTS[1], behaviour=("expert", "hover")[i % 2]) for i in range(count)]
    episodes = stack_episodes(made, TASKS)
    pushed = success("push_cube", episodes.ground_truth)
    return replace(episodes, success=np.stack([pushed] * len(TASKS), -1))


def first_weights(config: RunConfig, episodes: EpisodeArrays) -> tuple[Tokenizer, ActionModel, LatentEpisodes]:
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer, 32, 32)
    data = tokenise_episodes(tokenizer, episodes)
    return tokenizer, new_model(ActionModel, "action_model_init", tokenizer, data, config.world_model, 0), data


def test_one_instruction_per_task_trains_the_weights_of_one_instruction_per_batch_to_the_bit(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    config, episodes = config_of(), golden_episodes(16)
    tokenizer, action, data = first_weights(config, episodes)

    def trained() -> dict[str, Tensor]:
        model, _ = train_text_model(tokenizer, action, episodes, data, TEXTS, config, 0, None)
        return model.state_dict()

    found = trained()
    monkeypatch.setattr(TextModel, "forward", one_row_form)
    wanted = trained()
    assert found.keys() == wanted.keys() and len(golden_rows(episodes)) > 2
    assert [name for name, tensor in wanted.items() if not tensor.equal(found[name])] == []


def test_a_golden_row_has_its_own_instruction_for_its_task_and_else_the_tasks() -> None:
    episodes = replace(
        golden_episodes(4), instructions=("push the red square", "push it", "push it", ""),
        recorded_tasks=("push_cube", "push_cube", "reach", "push_cube"),
    )
    rows = np.array([(0, 1, 5), (0, 0, 5), (1, 1, 5), (2, 1, 5), (2, 0, 5), (3, 1, 5)])
    own = ["push the red square", TEXTS[0], "push it", TEXTS[1], "push it", TEXTS[1]]
    assert row_instructions(episodes, rows, TEXTS) == own


def test_an_episode_keeps_its_task_through_selection_and_concatenation() -> None:
    episodes = replace(golden_episodes(3), recorded_tasks=("push_cube", "reach", "push_cube"))
    both = EpisodeArrays.concatenate([episodes.select([1, 0]), episodes])
    assert both.recorded_tasks == ("reach", "push_cube", "push_cube", "reach", "push_cube")
    assert golden_episodes(2).recorded_tasks == ("push_cube", "push_cube")


def test_an_instruction_of_too_many_words_is_refused_before_training() -> None:
    config, episodes = config_of(), golden_episodes(16)
    episodes = replace(episodes, instructions=("push " * (MAX_WORDS + 1),) * len(episodes))
    tokenizer, action, data = first_weights(config, episodes)
    with pytest.raises(ValueError, match=f"length; this model knows at most {MAX_WORDS} of"):
        train_text_model(tokenizer, action, episodes, data, TEXTS, config, 0, None)


def test_episodes_with_one_first_frame_and_two_instructions_are_both_learned() -> None:
    config = config_of(world_model__text_num_iterations=30, world_model__learning_rate=2e-2)
    texts = ("move right", "move to the other side")
    made = [replace(episode(i, num_steps=2), instruction=texts[i % 2], behaviour="expert") for i in range(8)]
    episodes = stack_episodes(made, ("push_cube",))
    episodes = replace(episodes, success=np.tile(np.arange(3)[:, None] == 2, (8, 1, 1)))
    tokenizer, action, data = first_weights(config, episodes)
    first, *ends = (tokenizer.normalise(torch.randn(1, 8)).expand(16, -1) for _ in range(3))
    latents = torch.stack([torch.stack([first, *[ends[i % 2]] * 2]) for i in range(8)])
    data = replace(data, latents=latents.half(), mean_change_S=torch.ones(16))
    model, _ = train_text_model(tokenizer, action, episodes, data, ("push",), config, 0, None)
    assert model.condition.vocabulary == ("move", "other", "push", "right", "side", "the", "to")
    caches = model.trunk.new_caches()
    with torch.no_grad():
        terms = roll_out(lambda t, frames: model(frames, texts, caches), tokenizer, latents[:2, :1], 2)
    error = [[float((terms.next_latents[i] - ends[j]).square().mean()) for j in (0, 1)] for i in (0, 1)]
    assert error[0][0] < 0.2 * error[0][1] and error[1][1] < 0.2 * error[1][0], error
