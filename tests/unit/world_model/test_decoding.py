"""Parallel decoding of discrete frames, and the model that uses it."""

import math
from pathlib import Path

import pytest
import torch
from model_folders import spec_of
from pushing_scene import episode, stacked_scene
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.world_model import load_model_folder, save_model_folder
from wm_nodes.world_model.decoding import choose_codes, code_parts, code_targets, decided_after, decode_frame
from wm_nodes.world_model.quantizer import indices_to_bits
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.training.latent_episodes import tokenise_episodes
from wm_nodes.world_model.training.token_dynamics import MAX_CORRUPTION, corrupt, mask_tokens, train_token_model
from wm_nodes.world_model.training.tokenizer import train_tokenizer
from wm_nodes.world_model.validation.open_loop import evaluate_rollouts, imagine_episodes

BATCH, TOKENS, BITS = 3, 8, 4


def fixed_logits() -> Tensor:
    return torch.randn(BATCH, TOKENS, 2**BITS, generator=torch.Generator().manual_seed(0)) * 3


@pytest.mark.parametrize("num_passes", [1, 2, 4, 8])
def test_every_token_is_decided_once_and_keeps_its_code(num_passes: int) -> None:
    seen: list[Tensor] = []

    def predict(bits: Tensor, decided: Tensor) -> tuple[Tensor, ...]:
        seen.append(torch.where(decided.unsqueeze(-1), bits, torch.nan))
        return (torch.randn(BATCH, TOKENS, 2**BITS, generator=torch.Generator().manual_seed(len(seen))),)

    frame = decode_frame(predict, torch.zeros(BATCH, TOKENS, BITS), num_passes)
    assert len(seen) == num_passes
    assert frame.passes_BS.min() >= 1
    assert [int((frame.passes_BS[0] <= k).sum()) for k in range(1, num_passes + 1)] == decided_after(num_passes, TOKENS)
    for earlier in seen:
        kept = ~earlier.isnan()
        assert earlier[kept].equal(frame.bits_BSD[kept])


def test_one_pass_is_the_argmax_of_every_token() -> None:
    logits = fixed_logits()
    frame = decode_frame(lambda bits, decided: (logits,), torch.zeros(BATCH, TOKENS, BITS), 1)
    assert frame.bits_BSD.equal(indices_to_bits(logits.argmax(-1), BITS))


def test_the_most_confident_tokens_come_first() -> None:
    logits = torch.zeros(1, TOKENS, 2**BITS)
    logits[0, :, 3] = torch.tensor([1.0, 7, 3, 5, 2, 6, 4, 8])
    frame = decode_frame(lambda bits, decided: (logits,), torch.zeros(1, TOKENS, BITS), 4)
    most_confident_first = frame.passes_BS[0][logits[0, :, 3].argsort(descending=True)]
    assert most_confident_first.tolist() == [1, 2, 3, 3, 4, 4, 4, 4]


def test_the_schedule_is_the_cosine_one_and_always_advances() -> None:
    assert decided_after(4, 64) == [64 - math.ceil(64 * math.cos(math.pi * k / 8)) for k in (1, 2, 3)] + [64]
    assert decided_after(8, 8)[-1] == 8
    assert all(a < b for a, b in zip(decided_after(8, 8), decided_after(8, 8)[1:]))
    assert decided_after(8, 4) == [1, 2, 3, 4, 4, 4, 4, 4]


@pytest.mark.parametrize("num_bits", [3, 10, 11, 18])
def test_large_vocabularies_are_two_halves_that_put_together_give_the_code_back(num_bits: int) -> None:
    bits = (torch.rand(5, 7, num_bits, generator=torch.Generator().manual_seed(0)) > 0.5).float() * 2 - 1
    parts = code_parts(num_bits)
    assert sum(parts) == num_bits
    assert len(parts) == (1 if num_bits <= 10 else 2)
    logits = tuple(
        20 * torch.nn.functional.one_hot(index, 2**size).float() for index, size in zip(code_targets(bits), parts)
    )
    chosen, confidence = choose_codes(logits, num_bits)
    assert chosen.equal(bits)
    assert confidence.min() > -1e-3


def make_model(decoding_steps: int = 2) -> TokenActionModel:
    overrides = {"world_model.width": 24, "world_model.depth": 2, "world_model.num_heads": 2,
                 "world_model.decoding_steps": decoding_steps}
    torch.manual_seed(0)
    return TokenActionModel(
        load_config("base", overrides).world_model, num_tokens=TOKENS, latent_dim=BITS, action_dim=3, state_dim=3,
        num_tasks=1,
    ).eval()


def random_bits(*shape: int) -> Tensor:
    return (torch.rand(*shape, generator=torch.Generator().manual_seed(5)) > 0.5).float() * 2 - 1


@torch.no_grad()
def test_undecided_tokens_of_the_next_frame_are_not_looked_at_and_later_frames_do_not_leak_back() -> None:
    model, bits = make_model(), random_bits(2, 5, TOKENS, BITS)
    torch.manual_seed(1)
    condition = model.condition(torch.rand(2, 4, 3), torch.rand(2, 4, 3), torch.rand(2, 4, 3))
    decided = torch.zeros(2, 4, TOKENS, dtype=torch.bool)
    decided[:, :, ::2] = True
    before = model(bits[:, :-1], bits[:, 1:], decided, condition)
    hidden = torch.where(decided.unsqueeze(-1), bits[:, 1:], -bits[:, 1:])
    assert model(bits[:, :-1], hidden, decided, condition).logits[0].equal(before.logits[0])
    later = bits.clone()
    later[:, 3] *= -1
    after = model(later[:, :-1], torch.where(decided.unsqueeze(-1), bits[:, 1:], 0.0), decided, condition)
    assert after.logits[0][:, :3].equal(before.logits[0][:, :3])
    assert not after.logits[0][:, 3].equal(before.logits[0][:, 3])


@torch.no_grad()
@pytest.mark.parametrize("decoding_steps", [1, 3])
def test_drafts_leave_no_trace_in_the_cache(decoding_steps: int) -> None:
    model = make_model(decoding_steps)
    torch.manual_seed(2)
    actions, states = torch.rand(3, 2, 3), torch.rand(4, 2, 3)
    frames, done = [random_bits(2, TOKENS, BITS)], list[Tensor]()
    caches = model.trunk.new_ring_caches(2, torch.device("cpu"))
    for t in range(3):
        frame, logits = model.advance(frames[-1], actions[t], states[t], states[t + 1], caches)
        frames.append(frame)
        done.append(logits)
    clip = torch.stack(frames, 1)
    condition = model.condition(actions.transpose(0, 1), states[:-1].transpose(0, 1), states[1:].transpose(0, 1))
    whole = model(clip[:, :-1], clip[:, 1:], torch.ones(2, 3, TOKENS, dtype=torch.bool), condition)
    torch.testing.assert_close(torch.stack(done, 1), whole.done_logits_BTKJ, atol=1e-5, rtol=0)


def test_the_first_frame_is_never_corrupted_and_later_ones_at_most_as_said() -> None:
    bits = torch.ones(64, 5, 40, BITS)
    changed = (corrupt(bits, torch.Generator().manual_seed(0)) != bits).any(-1).float().mean((0, 2))
    assert changed[0] == 0
    assert 0.05 < changed[-1] < MAX_CORRUPTION


def test_half_of_the_frames_are_masked_wholly_and_the_others_in_part() -> None:
    masked = mask_tokens((200, 5, 40), torch.Generator().manual_seed(0))
    assert 0.4 < masked.all(-1).float().mean() < 0.65
    assert 0.7 < masked.float().mean() < 0.9


@pytest.mark.slow
def test_a_token_model_learns_a_scene_and_imagines_it_behind_the_environment_interface(tmp_path: Path) -> None:
    config = load_config("base", {
        "tokenizer.kind": "lfq", "tokenizer.patch_px": 8, "tokenizer.latent_dim": 8, "tokenizer.width": 24,
        "tokenizer.depth": 1, "tokenizer.num_iterations": 120, "tokenizer.batch_size": 32,
        "tokenizer.learning_rate": 3e-3, "world_model.width": 32, "world_model.depth": 1, "world_model.num_heads": 2,
        "world_model.num_iterations": 60, "world_model.batch_size": 16, "world_model.learning_rate": 3e-3,
    })
    episodes = stacked_scene([episode(i) for i in range(60)], ("push_cube",))
    tokenizer, _ = train_tokenizer(episodes, config, 0, None)
    data = tokenise_episodes(tokenizer, episodes)
    model, metrics = train_token_model(tokenizer, data, config, 0, tmp_path)
    assert metrics["accuracy"] > 0.5
    folder = save_model_folder(
        tmp_path / "model", tokenizer, model, None, config, spec=spec_of(config, tokenizer), tasks=("push_cube",),
        story={},
    )
    models = load_model_folder(folder)
    assert isinstance(models.action, TokenActionModel)
    some = episodes.select(range(8))
    results = evaluate_rollouts(models.tokenizer, imagine_episodes(models.tokenizer, models.action, some), some)
    assert results["psnr_rollout_db_h12"] > 10
