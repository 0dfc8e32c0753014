"""VideoAlign's reward from a folder, on a tiny random Qwen2-VL made here."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

transformers = pytest.importorskip("transformers")

from benchmarks.judge.comparisons.video_reward import (  # noqa: E402
    HEAD,
    REWARD_TOKENS,
    VIDEO_TOKEN,
    VideoPatches,
    fit_size,
    load_video_reward,
    to_patches,
)
from wm_nodes.judge.agent.types import TaskSpec, clip_ref  # noqa: E402

PATCH, MEAN, STD = 4, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4)
PICTURES = VideoPatches(PATCH, 2, 2, 64, 4096, MEAN, STD)
SCALES = {"VQ_mean": 0.1, "VQ_std": 2.0, "MQ_mean": 0.2, "MQ_std": 0.5, "TA_mean": -0.3, "TA_std": 1.5}
TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{% for c in m['content'] %}{% if c['type'] == 'video' %}"
    "<|vision_start|><|video_pad|><|vision_end|>{% else %}{{ c['text'] }}{% endif %}{% endfor %}<|im_end|>\n"
    "{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
FRAMES = np.random.default_rng(0).integers(0, 256, (16, 24, 32, 3), np.uint8)
CLIP, TASK = clip_ref("one", FRAMES, 8.0), TaskSpec("push the cube", "push", "panda", FRAMES[0])


def save_tiny_reward(folder: Path) -> None:
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast, Qwen2VLConfig, Qwen2VLForConditionalGeneration

    media = ["<|vision_start|>", "<|vision_end|>", VIDEO_TOKEN, "<|image_pad|>"]
    special = ["<pad>", "<|im_start|>", "<|im_end|>", *media, *REWARD_TOKENS]
    tokens = Tokenizer(models.BPE())
    tokens.pre_tokenizer, tokens.decoder = pre_tokenizers.ByteLevel(add_prefix_space=False), decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=320, special_tokens=special, initial_alphabet=alphabet)
    tokens.train_from_iterator(["rate the video"], trainer)
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=tokens, pad_token="<pad>", chat_template=TEMPLATE)
    tokenizer.save_pretrained(folder)
    ids = dict(zip(media, tokenizer.convert_tokens_to_ids(media)))
    torch.manual_seed(0)
    config = Qwen2VLConfig(
        text_config={
            "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2,
            "num_key_value_heads": 2, "vocab_size": len(tokenizer), "max_position_embeddings": 4096,
            "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 3, 3]},
        },
        vision_config={
            "depth": 2, "embed_dim": 16, "hidden_size": 32, "num_heads": 2, "patch_size": PATCH, "mlp_ratio": 2,
        },
        video_token_id=ids[VIDEO_TOKEN], image_token_id=ids["<|image_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"], vision_end_token_id=ids["<|vision_end|>"],
    )
    Qwen2VLForConditionalGeneration(config).eval().save_pretrained(folder)
    head = torch.randn(3, 32, generator=torch.Generator().manual_seed(1))
    save_file({HEAD: head}, folder / "reward_head.safetensors")
    pictures = {"patch_size": PATCH, "merge_size": 2, "temporal_patch_size": 2, "min_pixels": 64, "max_pixels": 4096,
                "image_mean": MEAN, "image_std": STD}
    (folder / "preprocessor_config.json").write_text(json.dumps(pictures))
    (folder / "model_config.json").write_text(json.dumps({"inference_config": SCALES}))
    picture, motion, text = REWARD_TOKENS
    (folder / "prompt.txt").write_text(f"Rate it. {picture} {motion} Prompt: {{text_prompt}} {text}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reward")
    save_tiny_reward(path)
    return path


def test_patches_are_those_of_the_librarys_image_processor() -> None:
    """It takes a picture as a video of two equal frames."""
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    frame = FRAMES[0]
    processor = Qwen2VLImageProcessorPil(
        patch_size=PATCH, merge_size=2, temporal_patch_size=2, min_pixels=64, max_pixels=4096, image_mean=list(MEAN),
        image_std=list(STD),
    )
    wanted = processor(images=[frame], return_tensors="pt")
    patches, grid = to_patches(torch.from_numpy(np.stack([frame, frame])), PICTURES)
    assert grid.tolist() == wanted["image_grid_thw"][0].tolist() == [1, 6, 8]
    assert_close(patches, wanted["pixel_values"].float(), atol=0.05, rtol=0)
    odd, grid = to_patches(torch.from_numpy(FRAMES[:3]), PICTURES)
    assert grid.tolist() == [2, 6, 8] and odd.shape == (96, 3 * 2 * PATCH * PATCH)


def test_sizes_are_multiples_within_the_limits() -> None:
    assert fit_size(24, 32, PICTURES) == (24, 32) and fit_size(27, 37, PICTURES) == (24, 40)
    high, wide = fit_size(480, 832, PICTURES)
    assert high * wide <= 4096 and high % 8 == wide % 8 == 0
    small = fit_size(4, 4, VideoPatches(PATCH, 2, 2, 256, 4096, MEAN, STD))
    assert small == (16, 16)


def test_a_score_is_the_head_at_its_token_normalised_and_overall_is_the_sum(folder: Path) -> None:
    from transformers import Qwen2VLForConditionalGeneration

    reward = load_video_reward(folder)
    found = reward.score(CLIP, TASK)
    assert found["Overall"] == pytest.approx(found["VQ"] + found["MQ"] + found["TA"])
    model = Qwen2VLForConditionalGeneration.from_pretrained(folder).eval()
    frames = torch.from_numpy(FRAMES[[0, 5, 10, 15]])  # 2 s at 2 per second
    patches, grid = to_patches(frames, PICTURES)
    ids = reward._token_ids(TASK.instruction, int(grid.prod()) // 4)
    with torch.no_grad():
        states = model.model(
            input_ids=ids, pixel_values_videos=patches, video_grid_thw=grid[None],
            mm_token_type_ids=torch.where(ids == model.config.video_token_id, 2, 0),
        ).last_hidden_state[0]
    head = load_file(folder / "reward_head.safetensors")[HEAD]
    place = ids[0].tolist().index(reward._id("<|MQ_reward|>"))
    assert found["MQ"] == pytest.approx((float(states[place] @ head[1]) - 0.2) / 0.5, rel=1e-4)
    other = reward.score(clip_ref("dark", FRAMES // 4, 8.0), TASK)
    assert other["VQ"] != found["VQ"], "the pictures count"
    assert reward.score(CLIP, TaskSpec("lift it", "lift", "panda", FRAMES[0]))["TA"] != found["TA"]


def without(name: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).unlink()


def replaced(name: str, text: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (without("prompt.txt"), "has no prompt.txt"),
        (without("reward_head.safetensors"), "no .*safetensors of .* holds rm_head.weight"),
        (replaced("prompt.txt", "{text_prompt}"), r"must hold <\|VQ_reward\|>, .* once"),
        (replaced("model_config.json", "{}"), "lacks VQ_mean, VQ_std"),
    ],
)
def test_a_folder_that_is_not_whole_is_refused(tmp_path: Path, damage: Callable[[Path], Any], complaint: str) -> None:
    save_tiny_reward(tmp_path)
    damage(tmp_path)
    with pytest.raises(ValueError, match=complaint):
        load_video_reward(tmp_path)
