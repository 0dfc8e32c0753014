"""Losses, schedule, resume, and that rollouts of a trained model follow a scene with contact."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from model_folders import spec_of
from pushing_scene import episode, stacked_scene
from torch.testing import assert_close

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import initial_weights
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.training.loop import EMA_DECAY, TrainingLoop
from wm_nodes.world_model import load_model_folder, save_model_folder, save_refreshed_folder
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.training.decoder import predict_all, train_decoder
from wm_nodes.world_model.training.done import bootstrap_masks, done_losses, done_mask
from wm_nodes.world_model.training.dynamics import (
    RolloutTerms,
    decoded_losses,
    rollout_steps_at,
    shown_frames,
    token_weights,
    train_action_model,
)
from wm_nodes.world_model.training.latent_episodes import LatentEpisodes, first_frames, tokenise_episodes, tool_moves
from wm_nodes.world_model.training.position_probe import train_position_probe
from wm_nodes.world_model.training.state_probe import train_state_probe
from wm_nodes.world_model.training.text import train_text_model
from wm_nodes.world_model.training.tokenizer import episode_targets, foreground_weight, train_tokenizer
from wm_nodes.world_model.validation.open_loop import auc, detection_metrics, evaluate_rollouts, imagine_episodes

TASKS = ("push_cube", "reach")


def config_of(**overrides: object) -> RunConfig:
    small = {
        "tokenizer.width": 32, "tokenizer.depth": 1, "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8,
        "tokenizer.batch_size": 32, "tokenizer.num_iterations": 250, "tokenizer.learning_rate": 3e-3,
        "world_model.width": 32, "world_model.depth": 1, "world_model.num_heads": 2, "world_model.batch_size": 16,
        "world_model.num_iterations": 260, "world_model.learning_rate": 3e-3, "world_model.rollout_steps": [3, 12],
        "world_model.state_weight": 2.0,
    }
    return load_config("base", small | {key.replace("__", "."): value for key, value in overrides.items()})


def arrays(count: int, first_seed: int = 0) -> EpisodeArrays:
    return stacked_scene([episode(first_seed + i) for i in range(count)], TASKS)


def test_on_another_table_only_the_object_is_foreground_where_it_is_what_differs_from_its_surroundings() -> None:
    median, image = torch.full((3, 64, 64), 0.2), torch.full((1, 3, 64, 64), 0.8)
    image[..., 30:34, 40:44] = 0.3
    settings = config_of(tokenizer__foreground_weight=4.0, tokenizer__foreground="surroundings").tokenizer
    weight = foreground_weight(image, median, settings)[0, 0]
    assert weight[30:34, 40:44].min() == 5 and weight[:20].max() == pytest.approx(1, abs=1e-3)
    whole_table = foreground_weight(image, median, settings.model_copy(update={"foreground": "background"}))[0, 0]
    assert whole_table[:20].min() == 5 and whole_table[31, 41] < 5


def test_the_done_loss_of_one_half_on_balanced_labels_is_log_two() -> None:
    logits, labels = torch.zeros(2, 3, 1, 1), torch.tensor([[0.0, 1, 0], [1, 0, 1]]).unsqueeze(-1)
    assert_close(done_losses(logits, labels, torch.ones(2, 3, 1, 1)), torch.log(torch.tensor(2.0)))


def test_masked_steps_do_not_count_in_the_done_loss() -> None:
    logits, labels = torch.tensor([[[[9.0]], [[9.0]]]]), torch.tensor([[[1.0], [0.0]]])
    assert done_losses(logits, labels, torch.tensor([[[[1.0]], [[0.0]]]])) < 1e-3


def untrained(episodes: EpisodeArrays) -> LatentEpisodes:
    """The episodes as tokens of a tokenizer without training."""
    return tokenise_episodes(Tokenizer(config_of().tokenizer, *episodes.images.shape[2:4]), episodes)


def test_a_part_is_what_was_recorded_from_its_first_frame_on() -> None:
    lengths = torch.tensor([12, 12, 5, 3])
    moves = torch.ones(4, 12, dtype=torch.bool)
    drawn = torch.stack([first_frames(lengths, moves, 4, torch.Generator().manual_seed(i)) for i in range(200)])
    assert drawn.amax(0).tolist() == [8, 8, 1, 0] and not drawn.amin(0).any()
    data = untrained(arrays(3))
    part = data.parts(torch.tensor([2, 0]), torch.tensor([3, 8]), 4)
    for name in ("latents", "states", "success", "truth"):
        values = getattr(data, name)
        assert_close(getattr(part, name), torch.stack([values[2, 3:8], values[0, 8:13]]), equal_nan=True)
    assert_close(part.actions, torch.stack([data.actions[2, 3:7], data.actions[0, 8:12]]))
    assert part.step_mask.shape == (2, 4) and part.step_mask.all()


def test_most_parts_hold_a_step_of_which_the_tool_moves() -> None:
    data = untrained(arrays(2))
    data.states[0, 3:] = data.states[0, 3]
    data.states[1] = data.states[1, 0]
    moves = tool_moves(data)
    assert moves[0, :3].any() and not moves[0, 3:].any() and moves[1].tolist() == data.step_mask[1].tolist()
    lengths = torch.tensor([12, 12])
    drawn = torch.stack([first_frames(lengths, moves, 2, torch.Generator().manual_seed(i)) for i in range(400)])
    still = (drawn > 2).float().mean(0)
    assert 0.1 < still[0] < 0.3 and still[1] > 0.6 and drawn.max() == 10


def test_a_model_trains_on_parts_of_episodes() -> None:
    config, episodes = config_of(world_model__part_steps=5, world_model__num_iterations=3), arrays(4)
    tokenizer, _ = train_tokenizer(episodes, config_of(tokenizer__num_iterations=2), 0, None)
    model, metrics = train_action_model(tokenizer, episodes, config, 0, None)
    assert np.isfinite(metrics["loss"])
    whole, _ = train_action_model(tokenizer, episodes, config_of(world_model__num_iterations=3), 0, None)
    assert not torch.equal(model.change.weight, whole.change.weight)


def test_a_done_output_learns_from_the_episodes_that_show_whether_its_task_is_done() -> None:
    data = replace(untrained(arrays(2)), labelled=torch.tensor([[True, False], [True, True]]))
    heads = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
    mask = done_mask(data, torch.tensor([0, 1, 0]), torch.ones(3, 12), heads)
    assert mask.shape == (3, 12, 2, 2)
    assert mask[:, 0].tolist() == [[[1, 0], [0, 0]], [[1, 1], [1, 1]], [[1, 0], [1, 0]]]


def test_the_curriculum_gives_each_stage_an_equal_share() -> None:
    assert [rollout_steps_at(i, 8, [1, 4, 16, 16]) for i in range(8)] == [1, 1, 4, 4, 16, 16, 16, 16]
    assert rollout_steps_at(99, 8, [1, 4]) == 4


def test_tokens_that_changed_more_than_usual_weigh_more() -> None:
    latents = torch.zeros(1, 2, 2, 4)
    latents[0, 1, 1] = 1.0
    assert token_weights(latents, torch.tensor([1.0, 0.5]))[0, 0].tolist() == [0.5, 1.5]


def test_done_heads_learn_from_different_episodes_unless_there_is_one() -> None:
    masks = bootstrap_masks(1000, 3, 0)
    assert 0.6 < masks.mean() < 0.8
    assert not masks[:, 0].equal(masks[:, 1])
    assert bootstrap_masks(10, 1, 0).min() == 1


def test_shorter_episodes_are_padded_by_their_last_frame_and_masked() -> None:
    stacked = stack_episodes([episode(0, num_steps=4), episode(1, num_steps=2)], TASKS)
    assert stacked.step_mask.tolist() == [[True] * 4, [True, True, False, False]]
    np.testing.assert_array_equal(stacked.images[1, 4], stacked.images[1, 2])
    assert stacked.success.shape == (2, 5, 2)


def test_episodes_of_different_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="different image"):
        stack_episodes([episode(0, size=32), episode(1, size=64)], TASKS)
    with pytest.raises(ValueError, match="no episodes"):
        stack_episodes([], TASKS)


def test_a_resumed_run_takes_the_same_steps_as_one_that_was_not_stopped(tmp_path: Path) -> None:
    def loop(folder: Path | None) -> TrainingLoop:
        torch.manual_seed(0)
        return TrainingLoop("toy", torch.nn.Linear(3, 2), 30, 0.1, folder)

    def loss_of(made: TrainingLoop, stop_at: int = 30):  # type: ignore[no-untyped-def]
        def loss(iteration: int) -> dict[str, torch.Tensor]:
            if iteration == stop_at:
                made.save()
                raise KeyboardInterrupt
            x = torch.randn(4, 3, generator=torch.Generator().manual_seed(iteration))
            return {"loss": made.model(x).square().mean()}

        return loss

    whole = loop(None)
    whole.run(loss_of(whole))
    first = loop(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        first.run(loss_of(first, stop_at=7))
    assert first.iteration == 7
    second = loop(tmp_path)
    assert second.iteration == first.iteration
    second.run(loss_of(second))
    assert second.model.weight.equal(whole.model.weight)
    lines = [json.loads(line) for line in (tmp_path / "metrics_toy.jsonl").read_text().splitlines()]
    assert lines[-1]["iteration"] == 30


def test_the_average_has_the_bits_of_one_tensor_after_another_and_counts_are_copied() -> None:
    torch.manual_seed(0)
    made = TrainingLoop("toy", torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.BatchNorm1d(5)), 4, 0.1, None)
    expected = {name: tensor.clone() for name, tensor in made.model.state_dict().items()}
    for i in range(1, 5):
        made._step(lambda i: {"loss": made.model(torch.randn(4, 3)).exp().mean()})
        for name, tensor in made.model.state_dict().items():
            share = 1 - min(EMA_DECAY, (1 + i) / (10 + i))
            expected[name] = expected[name].lerp(tensor, share) if tensor.is_floating_point() else tensor.clone()
    assert int(made.averaged["1.num_batches_tracked"]) == 4
    assert [name for name, tensor in expected.items() if not tensor.equal(made.averaged[name])] == []


def test_a_checkpoint_of_another_architecture_is_one_clear_error(tmp_path: Path) -> None:
    TrainingLoop("toy", torch.nn.Linear(3, 2), 1, 0.1, tmp_path).save()
    with pytest.raises(ValueError, match="another architecture"):
        TrainingLoop("toy", torch.nn.Linear(4, 2), 1, 0.1, tmp_path)


def test_auc_counts_ties_half_and_detection_counts_episodes() -> None:
    scores, positive = np.array([0.9, 0.5, 0.5, 0.1], np.float32), np.array([True, True, False, False])
    tries = np.arange(4)
    assert auc(scores, positive) == pytest.approx((1 + 1 + 0.5 + 1) / 4)
    found = detection_metrics(scores, positive, positive, 0.6, tries)
    assert (found["precision"], found["recall"], found["agreement"]) == (1.0, 0.5, 0.75)
    assert np.isnan(detection_metrics(scores, np.zeros(4, bool), np.zeros(4, bool), 0.95, tries)["precision"])
    early = detection_metrics(scores, positive, np.zeros(4, bool), 0.6, tries)
    assert (early["precision"], early["in_time"], early["agreement"]) == (1.0, 0.0, 0.5)
    cut = [np.repeat(values, 5) for values in (scores, positive, positive)]
    assert detection_metrics(*cut, 0.6, np.repeat(tries, 5)) == found, "parts of one try say no more than the whole"


def test_decoded_losses_are_smallest_for_the_true_latents_and_reach_the_predictions_only() -> None:
    config, episodes = config_of(tokenizer__num_iterations=40), arrays(12)
    tokenizer, _ = train_tokenizer(episodes, config, 0, None)
    tokenizer.requires_grad_(False)
    data = tokenise_episodes(tokenizer, episodes)
    index = torch.arange(12)
    whole = torch.zeros(12, dtype=torch.int64), data.step_mask.sum(1)
    steps, images = shown_frames(data, index, *whole, torch.Generator().manual_seed(0))

    def losses(latents: torch.Tensor) -> dict[str, torch.Tensor]:
        terms = RolloutTerms(latents, torch.zeros(()), torch.zeros(()))
        return decoded_losses(terms, tokenizer, data, index, steps, images, config)

    true = data.latents[:, 1:].float().requires_grad_()
    right, wrong = losses(true), losses(true.detach().roll(1, 0))
    assert right.keys() == wrong.keys() == {"pixel", "recoded", "recoded_state"}
    assert all(right[key] < wrong[key] for key in right)
    sum(right.values()).backward()
    touched = (true.grad != 0).flatten(2).any(-1)
    assert touched.any(1).all() and int(touched.sum()) <= 2 * 12
    assert all(p.grad is None for p in tokenizer.parameters())


def test_a_finished_stage_still_tells_its_last_metrics(tmp_path: Path) -> None:
    made = TrainingLoop("toy", torch.nn.Linear(3, 2), 3, 0.1, tmp_path)
    metrics = made.run(lambda i: {"loss": made.model.weight.square().sum()})
    again = TrainingLoop("toy", torch.nn.Linear(3, 2), 3, 0.1, tmp_path)
    assert again.run(lambda i: {}) == metrics


def test_every_model_of_one_seed_has_equal_weights_whatever_the_global_generator_did_before() -> None:
    """Tokenizer, action model, text model, position probe; the generator is left as it was."""
    config = config_of(
        tokenizer__num_iterations=2, world_model__num_iterations=2, world_model__text_num_iterations=2,
        world_model__rollout_steps=[2],
    )
    episodes = arrays(8)
    episodes = replace(episodes, behaviours=("expert",) * len(episodes))

    def trained() -> dict[str, torch.Tensor]:
        tokenizer, _ = train_tokenizer(episodes, config, 3, None)
        data = tokenise_episodes(tokenizer, episodes)
        action, _ = train_action_model(tokenizer, data, config, 3, None)
        text, _ = train_text_model(
            tokenizer, action, episodes, data, ("push the square", "reach it"), config, 3, None
        )
        probe, _ = train_position_probe(episodes, config, 3, None)
        models = {"tokenizer": tokenizer, "action": action, "text": text, "probe": probe}
        return {f"{kind}.{name}": t.clone() for kind, model in models.items() for name, t in model.state_dict().items()}

    first, before = trained(), torch.get_rng_state()
    torch.rand(17)
    second = trained()
    assert not torch.equal(torch.get_rng_state(), before)
    assert [name for name, tensor in first.items() if not torch.equal(tensor, second[name])] == []
    disturbed = torch.get_rng_state()
    with initial_weights(0, "some_init"):
        torch.rand(3)
    assert torch.equal(torch.get_rng_state(), disturbed)


def test_a_probe_that_trains_on_alone_reads_positions_better_off_unchanged_latents() -> None:
    config = config_of(tokenizer__probe_iterations=150, tokenizer__num_iterations=60)
    training, heldout = arrays(40), arrays(8, 10_000)
    tokenizer, _ = train_tokenizer(training, config, 0, None)

    def error_cm() -> float:
        with torch.inference_mode():
            read = tokenizer.read_state(tokenizer.encode(heldout.images[:, 0])).numpy()
        return 100 * float(np.linalg.norm((read - episode_targets(heldout)[:, 0])[:, :2], axis=-1).mean())

    before, weights = error_cm(), {name: t.clone() for name, t in tokenizer.state_dict().items()}
    train_state_probe(tokenizer, tokenise_episodes(tokenizer, training), config.tokenizer, 0, None)
    changed = {name for name, t in tokenizer.state_dict().items() if not torch.equal(t, weights[name])}
    assert changed and all(name.startswith("probe.") for name in changed)
    assert error_cm() < 0.7 * before
    assert not any(p.requires_grad for p in tokenizer.probe.parameters())


@pytest.mark.slow
def test_a_decoder_for_rollouts_shows_them_closer_to_the_recording_and_leaves_the_tokenizer_alone(
    tmp_path: Path,
) -> None:
    config = config_of(
        tokenizer__decoder_iterations=60, tokenizer__adversarial_weight=0.05, tokenizer__num_iterations=60,
        world_model__num_iterations=20,
    )
    training = arrays(40)
    tokenizer, _ = train_tokenizer(training, config, 0, None)
    data = tokenise_episodes(tokenizer, training)
    model, _ = train_action_model(tokenizer, data, config, 0, None)
    imagined, wanted = predict_all(tokenizer, model, data).float(), data.images[:, 1:]
    assert imagined.shape == data.latents[:, 1:].shape

    def error(shown_by: Tokenizer) -> float:
        with torch.inference_mode():
            shown = shown_by.decode(imagined[data.step_mask])
        return float((shown.float() - wanted[data.step_mask].float()).abs().mean())

    weights = {name: t.clone() for name, t in tokenizer.state_dict().items()}
    shown_by, metrics = train_decoder(tokenizer, model, data, config, 0, None)
    assert {"pixel", "recoded", "adversarial", "discriminator"} <= metrics.keys()
    assert all(torch.equal(t, weights[name]) for name, t in tokenizer.state_dict().items())
    changed = {name for name, t in shown_by.state_dict().items() if not torch.equal(t, weights[name])}
    assert changed and all(name.startswith("decoder.") for name in changed)
    assert error(shown_by) < 0.9 * error(tokenizer)

    decoder = shown_by.decoder
    folder = save_model_folder(
        tmp_path, tokenizer, model, None, config, spec=spec_of(config, tokenizer), tasks=TASKS, story={},
        decoder=decoder,
    )
    refreshed = save_refreshed_folder(tmp_path / "refreshed", folder, model, {})
    for where, rollouts, meant in ((folder, True, shown_by), (refreshed, True, shown_by), (folder, False, tokenizer)):
        loaded = load_model_folder(where, rollout_decoder=rollouts).tokenizer
        for name, weight in loaded.state_dict().items():
            assert_close(weight, meant.state_dict()[name], atol=1e-3, rtol=1e-3)


@pytest.mark.slow
def test_rollouts_of_a_trained_model_follow_pushed_objects_better_than_copying_the_first_frame() -> None:
    config, training = config_of(tokenizer__num_iterations=100, world_model__num_iterations=60), arrays(120)
    tokenizer, tokenizer_metrics = train_tokenizer(training, config, 0, None)
    assert tokenizer_metrics["psnr_db"] > 22
    data = tokenise_episodes(tokenizer, training)
    model, _ = train_action_model(tokenizer, data, config, 0, None)
    heldout = arrays(32, 10_000)
    metrics = evaluate_rollouts(tokenizer, imagine_episodes(tokenizer, model, heldout), heldout, threshold=0.5)
    assert metrics["tool_ratio_h12"] < 0.6
    assert metrics["object_moved_ratio_h12"] < 0.7
