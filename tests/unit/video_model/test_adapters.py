"""Public video models behind VelocityModel, on tiny randomly initialised models of the same classes.

Parity is against diffusers' own pipelines run from noise to latents, never against a copy of our code.
"""

import copy
import json
import logging
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close

diffusers = pytest.importorskip("diffusers")
transformers = pytest.importorskip("transformers")
pytest.importorskip("peft")

from pretended_device import Device  # noqa: E402
from safetensors.torch import load_file  # noqa: E402
from video_toys import grpo_config, kl_config, rollout_config  # noqa: E402

from wm_nodes.apps.cli import main  # noqa: E402
from wm_nodes.config.video import RolloutConfig  # noqa: E402
from wm_nodes.core.imports import MissingPackageError  # noqa: E402
from wm_nodes.core.model_folder import ModelFolderError  # noqa: E402
from wm_nodes.video_model import (  # noqa: E402
    Condition,
    RolloutBuffer,
    StepContext,
    config_hash,
    guided_velocity,
    initial_noise,
    sample_videos,
)
from wm_nodes.video_model.adapters import (  # noqa: E402
    CosmosVelocity,
    PublicVelocity,
    VideoCodec,
    WanVelocity,
    add_lora,
    load_public_model,
    save_lora,
)
from wm_nodes.video_model.adapters.loading import embed_prompts  # noqa: E402
from wm_nodes.video_model.kernels import ode_step, with_conditioning  # noqa: E402
from wm_nodes.video_rl.grpo import GrpoLearner  # noqa: E402

C, L, E = 4, 6, 8
FRAMES, SIDE = 3, 4  # latent; 9 camera frames of 32x32
WORDS = ["<pad>", "</s>", "<unk>", "push", "the", "cube", "left", "right"]
for _name in ("diffusers", "transformers"):
    logging.getLogger(_name).setLevel(logging.ERROR)


# tiny models of the real classes


def randomised(model: Any, seed: int = 0) -> Any:
    """Weights without the zeros and ones of an untrained model, so that every input matters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=generator))
    return model.eval()


def wan_transformer(in_channels: int = C, **changes: Any) -> Any:
    settings: dict[str, Any] = {
        "num_attention_heads": 2, "attention_head_dim": 12, "in_channels": in_channels, "out_channels": C,
        "text_dim": E, "freq_dim": 16, "ffn_dim": 32, "num_layers": 2, "rope_max_seq_len": 32,
    }
    torch.manual_seed(0)
    return randomised(diffusers.WanTransformer3DModel(**settings | changes))


def cosmos_transformer(**changes: Any) -> Any:
    settings: dict[str, Any] = {
        "in_channels": C + 1, "out_channels": C, "num_attention_heads": 2, "attention_head_dim": 12, "num_layers": 2,
        "mlp_ratio": 2, "text_embed_dim": E, "adaln_lora_dim": 4, "max_size": (8, 32, 32),
        "extra_pos_embed_type": None, "concat_padding_mask": False,
    }
    torch.manual_seed(0)
    return randomised(diffusers.CosmosTransformer3DModel(**settings | changes))


def tiny_vae() -> Any:
    mean, std = [0.3, -0.2, 0.1, 0.0], [1.5, 0.7, 2.0, 1.0]
    torch.manual_seed(0)
    return diffusers.AutoencoderKLWan(
        base_dim=4, z_dim=C, dim_mult=[1, 1, 1, 1], num_res_blocks=1, temperal_downsample=[False, True, True],
        latents_mean=mean, latents_std=std,
    ).eval()


def tiny_t5() -> Any:
    config = transformers.UMT5Config(vocab_size=len(WORDS), d_model=E, d_kv=4, d_ff=8, num_layers=1, num_heads=2)
    torch.manual_seed(0)
    return transformers.UMT5EncoderModel(config).eval()


def tiny_qwen() -> Any:
    text = {
        "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
        "num_key_value_heads": 1, "vocab_size": len(WORDS), "max_position_embeddings": 64, "bos_token_id": 0,
        "eos_token_id": 1, "pad_token_id": 0, "rope_scaling": {"type": "mrope", "mrope_section": [1, 1, 2]},
    }
    vision = {"depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2, "out_hidden_size": 16}
    torch.manual_seed(0)
    config = transformers.Qwen2_5_VLConfig(text_config=text, vision_config=vision)
    return transformers.Qwen2_5_VLForConditionalGeneration(config).eval()


def tiny_tokenizer(chat: bool = False) -> Any:
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<pad>", eos_token="</s>", unk_token="<unk>"
    )
    if chat:
        tokenizer.chat_template = "{% for m in messages %}{{ m['content'][0]['text'] }} {% endfor %}"
    return tokenizer


def euler(**changes: Any) -> Any:
    return diffusers.FlowMatchEulerDiscreteScheduler(**{"shift": 3.0} | changes)


def unipc() -> Any:
    return diffusers.UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=5.0)


class NoCheck(nn.Module):
    """In place of NVIDIA's guardrail, which is another package."""

    device, dtype = torch.device("cpu"), torch.float32

    def check_text_safety(self, _text: str) -> bool:
        return True

    def check_video_safety(self, video: Any) -> Any:
        return video


def wan_pipeline(**changes: Any) -> Any:
    parts = {
        "tokenizer": tiny_tokenizer(), "text_encoder": tiny_t5(), "vae": tiny_vae(), "scheduler": euler(),
        "transformer": wan_transformer(),
    } | changes
    return diffusers.WanPipeline(**parts)


def wan_image_pipeline(**changes: Any) -> Any:
    parts = {
        "tokenizer": tiny_tokenizer(), "text_encoder": tiny_t5(), "vae": tiny_vae(), "scheduler": euler(),
        "transformer": wan_transformer(), "expand_timesteps": True,
    } | changes
    return diffusers.WanImageToVideoPipeline(**parts)


def cosmos25_pipeline(**changes: Any) -> Any:
    parts = {
        "tokenizer": tiny_tokenizer(chat=True), "text_encoder": tiny_qwen(), "vae": tiny_vae(), "scheduler": euler(),
        "transformer": cosmos_transformer(), "safety_checker": NoCheck(),
    } | changes
    return diffusers.Cosmos2_5_PredictBasePipeline(**parts)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


NOISE, TEXT, NULL = normal(1, C, FRAMES, SIDE, SIDE, seed=1), normal(1, L, E, seed=2), normal(1, L, E, seed=3)
PIXELS = {"height": 8 * SIDE, "width": 8 * SIDE, "num_frames": 1 + 4 * (FRAMES - 1)}
CALL: dict[str, Any] = {**PIXELS, "output_type": "latent", "return_dict": False}


def given(frames: Tensor | None = None, text: Tensor = TEXT) -> Condition:
    frames = NOISE.new_zeros(1, C, 0, SIDE, SIDE) if frames is None else frames
    return Condition(frames, NOISE.new_zeros(1, FRAMES - 1, 0), text)


def picture(value: int = 0) -> Tensor:
    """One camera frame, uint8 (1, 1, 32, 32, 3)."""
    return torch.randint(0, 256, (1, 1, 32, 32, 3), generator=torch.Generator().manual_seed(value), dtype=torch.uint8)


def as_image(frame: Tensor) -> Tensor:
    """For the pipelines: (1, 3, 32, 32) in [0, 1]."""
    return frame[:, 0].permute(0, 3, 1, 2).float() / 255


def follow(model: PublicVelocity, times: Tensor, condition: Condition, cfg: float, noise: Tensor = NOISE) -> Tensor:
    """Our sampler at eta = 0 on the given times."""
    context = StepContext(condition.frames, float(times[1]))
    x = with_conditioning(noise, condition.frames)
    with torch.no_grad():
        for t, s in zip(times.double()[:-1], times.double()[1:]):
            v = guided_velocity(model, x, t.expand(1), condition, cfg)
            x = with_conditioning(ode_step(x, v, t.expand(1), s.expand(1), context).mean, condition.frames)
    return x


class TestParityWithThePipelines:
    @pytest.mark.parametrize("scale", [1.0, 5.0])
    def test_wan_text_to_video(self, scale: float) -> None:
        pipeline = wan_pipeline()
        theirs = pipeline(
            prompt_embeds=TEXT, negative_prompt_embeds=NULL, latents=NOISE, num_inference_steps=4,
            guidance_scale=scale, **CALL,
        )[0]
        model = WanVelocity(pipeline.transformer, NULL[0])
        ours = follow(model, pipeline.scheduler.sigmas, given(), scale)
        assert_close(ours, theirs, atol=2e-5, rtol=1e-4)

    def test_wan_one_euler_step_is_the_schedulers(self) -> None:
        scheduler, transformer = euler(), wan_transformer()
        scheduler.set_timesteps(5)
        t, s = scheduler.sigmas[2:4].double()
        with torch.no_grad():
            told = scheduler.timesteps[2].expand(1)
            out = transformer(NOISE, told, TEXT, return_dict=False)[0]
            theirs = scheduler.step(out, scheduler.timesteps[2], NOISE, return_dict=False)[0]
            v = WanVelocity(transformer)(NOISE, t.expand(1), given())
        ours = ode_step(NOISE, v, t.expand(1), s.expand(1), StepContext(given().frames, 0.9)).mean
        assert_close(ours, theirs, atol=1e-5, rtol=1e-5)

    def test_wan_fused_first_frame(self) -> None:
        pipeline, frame = wan_image_pipeline(), picture()
        theirs = pipeline(
            image=as_image(frame), prompt_embeds=TEXT, negative_prompt_embeds=NULL, latents=NOISE,
            num_inference_steps=4, guidance_scale=3.0, **CALL,
        )[0]
        condition = given(VideoCodec(pipeline.vae).encode(frame))
        ours = follow(
            WanVelocity(pipeline.transformer, NULL[0], fused=True), pipeline.scheduler.sigmas, condition, 3.0
        )
        assert_close(ours, theirs, atol=2e-5, rtol=1e-4)

    @pytest.mark.parametrize("scale", [0.0, 7.0])
    @pytest.mark.parametrize("with_frame", [False, True])
    def test_cosmos25(self, scale: float, with_frame: bool) -> None:
        pipeline, frame = cosmos25_pipeline(), picture()
        video = torch.cat([as_image(frame)] * 9).permute(1, 0, 2, 3).unsqueeze(0) * 2 - 1 if with_frame else None
        theirs = pipeline(
            video=video, prompt_embeds=TEXT, negative_prompt_embeds=NULL, latents=NOISE, num_inference_steps=4,
            guidance_scale=scale, num_latent_conditional_frames=1, **CALL,
        )[0]
        frames = VideoCodec(pipeline.vae).encode(frame) if with_frame else None
        model = CosmosVelocity(pipeline.transformer, NULL[0])
        ours = follow(model, pipeline.scheduler.sigmas, given(frames), 1 + scale)
        assert_close(ours, theirs, atol=5e-5, rtol=1e-4)

    def test_cosmos_padding_channel_is_zero_and_needs_no_torchvision(self, monkeypatch: pytest.MonkeyPatch) -> None:
        module = sys.modules[diffusers.CosmosTransformer3DModel.__module__]
        transformer = cosmos_transformer(concat_padding_mask=True)
        model = CosmosVelocity(copy.deepcopy(transformer), NULL[0])

        class Nearest:
            class functional:
                @staticmethod
                def resize(mask: Tensor, size: list[int], **_: Any) -> Tensor:
                    return F.interpolate(mask, size, mode="nearest")

            class InterpolationMode:
                NEAREST = "nearest"

        if not hasattr(module, "transforms"):
            monkeypatch.setattr(module, "transforms", Nearest, raising=False)
        with torch.no_grad():
            theirs = transformer(
                NOISE, torch.tensor([0.7]).view(1, 1, 1, 1, 1).expand(1, 1, FRAMES, 1, 1), TEXT,
                condition_mask=torch.zeros(1, 1, FRAMES, SIDE, SIDE), padding_mask=torch.zeros(1, 1, 32, 32),
                return_dict=False,
            )[0]
            assert torch.equal(model(NOISE, torch.tensor([0.7]), given()), theirs)


class TestGuidance:
    def test_dropped_rows_see_the_negative_prompt_and_others_do_not(self) -> None:
        model = WanVelocity(wan_transformer(), NULL[0])
        x, t, text = NOISE.repeat(2, 1, 1, 1, 1), torch.tensor([0.5, 0.5]), TEXT.repeat(2, 1, 1)
        condition = Condition(x[:, :, :0], torch.zeros(2, FRAMES - 1, 0), text)
        out = model(x, t, condition, torch.tensor([False, True]))
        assert_close(out[:1], model(NOISE, t[:1], given()), atol=1e-5, rtol=1e-4)
        assert_close(out[1:], model(NOISE, t[:1], given(text=NULL)), atol=1e-5, rtol=1e-4)

    def test_missing_or_other_negative_prompt_is_refused(self) -> None:
        drop = torch.tensor([True])
        with pytest.raises(ValueError, match="negative prompt"):
            WanVelocity(wan_transformer())(NOISE, torch.tensor([0.5]), given(), drop)
        with pytest.raises(ValueError, match="embed both with embed_prompts"):
            WanVelocity(wan_transformer(), NULL[0, :3])(NOISE, torch.tensor([0.5]), given(), drop)


class TestText:
    @pytest.mark.parametrize("kind", ["wan", "cosmos2.5"])
    def test_prompts_are_padded_to_one_length(self, kind: str) -> None:
        pipeline = {"wan": wan_pipeline, "cosmos2.5": cosmos25_pipeline}[kind]()
        prompts = ["push  the cube &amp; left", "push"]
        text = embed_prompts(pipeline, prompts)
        assert text.shape == (2, 512, E if kind == "wan" else 32) and not text.requires_grad
        assert not torch.equal(text[0], text[1])

    def test_projected_text_gives_the_same_velocity_in_less_memory(self) -> None:
        changes = {
            "use_crossattn_projection": True,
            "crossattn_proj_in_channels": 40,
            "encoder_hidden_states_channels": E,
        }
        model = CosmosVelocity(cosmos_transformer(**changes), normal(L, 40, seed=8))
        text, t = normal(1, L, 40, seed=7), torch.tensor([0.4])
        before = guided_velocity(model, NOISE, t, given(text=text), 2.0)
        projected = model.project_text(text)
        assert projected.shape == (1, L, E)
        assert torch.equal(guided_velocity(model, NOISE, t, given(text=projected), 2.0), before)


def rollout_of(
    model: PublicVelocity, condition: Condition, settings: RolloutConfig, version: int, iteration: int
) -> RolloutBuffer:
    """Two groups of two videos, rewarded by their mean brightness."""
    N = 4
    rows = condition.repeat_interleave(N)
    seeds = torch.arange(N) + 100 * iteration
    videos = sample_videos(model, rows, initial_noise(tuple(NOISE.shape[1:]), seeds), seeds, settings)
    unrewarded = RolloutBuffer(
        videos, rows, torch.tensor([0, 0, 1, 1]), torch.arange(N), {}, version, iteration, config_hash(settings),
    )
    return unrewarded.with_rewards({"total": videos.latents.mean((1, 2, 3, 4))})


def adapters() -> dict[str, PublicVelocity]:
    return {
        "wan": WanVelocity(wan_transformer(), NULL[0], fused=True),
        "cosmos2.5": CosmosVelocity(cosmos_transformer(), NULL[0]),
    }


class TestTraining:
    @pytest.mark.parametrize("kind", ["wan", "cosmos2.5"])
    @pytest.mark.parametrize("lora", [False, True], ids=["full", "lora"])
    def test_two_iterations_change_the_weights_and_start_at_ratio_one(self, kind: str, lora: bool) -> None:
        model = adapters()[kind]
        if lora:
            add_lora(model, 2, 4)
        settings = rollout_config(num_steps=4, shift=3.0, cfg=2.0, micro_batch=4)
        anchor: Any = "lora_off" if lora else "frozen"
        learner = GrpoLearner(
            model,
            grpo_config(
                kl=kl_config(beta=0.1, anchor=anchor), learning_rate=1e-2, updates_per_buffer=2,
                step_fraction=1.0, micro_batch=4,
            ),
            settings,
            seed=0,
        )
        before = {name: p.detach().clone() for name, p in model.named_parameters()}
        clean = normal(1, C, 1, SIDE, SIDE, seed=4)
        for iteration in range(2):
            buffer = rollout_of(model, given(clean), settings, learner.version, iteration)
            assert torch.equal(buffer.rollout.latents[:, :, :1], clean.expand(4, -1, -1, -1, -1))
            report = learner.train(buffer)
            first, second = report.updates
            assert first.ratio_mean == pytest.approx(1.0, abs=1e-5)
            assert first.clip_low_share == first.clip_high_share == 0
            assert first.grad_norm > 0 and second.ratio_mean != 1.0
            assert (first.kl < 1e-9) == (iteration == 0), "the anchor is the start, not the last buffer"
        changed = {name for name, p in model.named_parameters() if not torch.equal(p, before[name])}
        trained = {name for name, p in model.named_parameters() if p.requires_grad}
        assert changed <= trained and len(changed) > len(trained) / 2
        assert bool(trained) and all(("lora_" in name) == lora for name in trained)

    def test_gradient_checkpointing_gives_the_same_gradients(self) -> None:
        for plain in adapters().values():
            checkpointed = copy.deepcopy(plain)
            checkpointed.transformer.enable_gradient_checkpointing()
            for model in (plain, checkpointed):
                model(NOISE, torch.tensor([0.6]), given(normal(1, C, 1, SIDE, SIDE))).square().sum().backward()
            for mine, other in zip(plain.parameters(), checkpointed.parameters()):
                assert (mine.grad is None) == (other.grad is None)
                if mine.grad is not None and other.grad is not None:
                    assert_close(mine.grad, other.grad)

    @pytest.mark.parametrize("kind", ["wan", "cosmos2.5"])
    def test_bfloat16_weights_stay_near_float32(self, kind: str) -> None:
        exact, half = (adapters()[kind] for _ in range(2))
        half.transformer.to(torch.bfloat16)
        add_lora(half, 2)
        assert {p.dtype for name, p in half.named_parameters() if "lora_" in name} == {torch.float32}
        condition, t = given(normal(1, C, 1, SIDE, SIDE)), torch.tensor([0.6])
        wanted = exact(NOISE, t, condition)
        found = half(NOISE, t, condition)
        assert found.dtype == torch.float32
        assert not torch.equal(found, wanted)
        assert float(((found - wanted).norm() / wanted.norm()).detach()) < 0.05
        found.square().sum().backward()
        assert all(p.grad is not None for p in half.parameters() if p.requires_grad)


class TestLora:
    @pytest.mark.parametrize("kind", ["wan", "cosmos2.5"])
    def test_off_is_the_base_model_bit_for_bit_and_files_bring_it_back(self, kind: str, tmp_path: Path) -> None:
        model, condition, t = adapters()[kind], given(normal(1, C, 1, SIDE, SIDE)), torch.tensor([0.6])
        base = model(NOISE, t, condition)
        add_lora(model, 2, 8)
        assert torch.equal(model(NOISE, t, condition), base), "an adapter starts as no change"
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if "lora_B" in name:
                    parameter.copy_(normal(*parameter.shape, seed=len(name)))
        tuned = model(NOISE, t, condition)
        assert not torch.equal(tuned, base)
        with model.disable_adapter():
            assert torch.equal(model(NOISE, t, condition), base)
        assert torch.equal(model(NOISE, t, condition), tuned)
        assert all(p.requires_grad == ("lora_" in name) for name, p in model.named_parameters())
        save_lora(model, tmp_path)
        other = adapters()[kind]
        other.transformer.load_lora_adapter(str(tmp_path), prefix=None, use_safetensors=True)
        assert torch.equal(other(NOISE, t, condition), tuned)
        assert not [p for p in tmp_path.rglob("*") if p.suffix in (".bin", ".pt", ".pkl")]

    def test_switching_off_what_is_not_there_is_refused(self, tmp_path: Path) -> None:
        model = adapters()["wan"]
        with pytest.raises(ValueError, match="no LoRA adapter"), model.disable_adapter():
            pass
        with pytest.raises(ValueError, match="no LoRA adapter"):
            save_lora(model, tmp_path)
        add_lora(model, 1)
        with pytest.raises(ValueError, match="already"):
            add_lora(model, 1)


class TestCodec:
    def test_latents_are_the_pipelines_and_become_frames_again(self) -> None:
        vae, frames = tiny_vae(), picture().repeat(2, 9, 1, 1, 1)
        latents = VideoCodec(vae).encode(frames)
        assert latents.shape == (2, C, 3, 4, 4)
        mean, std = (torch.tensor(v).view(1, C, 1, 1, 1) for v in (vae.config.latents_mean, vae.config.latents_std))
        video = diffusers.video_processor.VideoProcessor(8).preprocess_video([list(frames[0].float().numpy() / 255)])
        theirs = (vae.encode(video).latent_dist.mode() - mean) / std
        assert_close(latents[:1], theirs, atol=1e-5, rtol=1e-5)
        decoded = VideoCodec(vae).decode(latents)
        assert decoded.shape == frames.shape and decoded.dtype == torch.uint8

    def test_sizes_that_it_does_not_divide_are_named(self) -> None:
        with pytest.raises(ValueError, match="8 frames of 32x32"):
            VideoCodec(tiny_vae()).encode(picture().repeat(1, 8, 1, 1, 1))


def run_documented(folder: Path, out: Path, device: str, dtype: str, text_only: bool = False) -> dict[str, Any]:
    """The documented training of a public model, on two contexts; the reward stays where the clips are.

    text_only: with the line that the page gives for Wan 2.1.
    """
    page = (Path(__file__).parents[3] / "wm_nodes" / "docs" / "public_video_models.md").read_text()
    (block,) = re.findall(r"## Training a public model.*?```python\n(.*?)```", page, re.DOTALL)
    (line,) = re.findall(r"`(contexts = contexts\..*?)`", page)
    if text_only:
        block = block.replace("C, _, H, W =", f"{line}\nC, _, H, W =")
    small = {"rollout.num_steps": 4, "groups.group_size": 4, "grpo.advantage.best_of_n": 2}
    scope: dict[str, Any] = {
        "folder": folder, "dtype": dtype, "device": device, "frames": torch.cat([picture(), picture(1)]),
        "prompts": ["push the cube", "push left"], "settings": {**small, "grpo.learning_rate": 1e-3},
        "latent_frames": FRAMES, "iterations": 2, "out": out,
        "reward": lambda clips: clips.double().mean((1, 2, 3, 4)),
    }
    exec(block, scope)
    return scope


class TestFolder:
    @pytest.fixture(scope="class")
    def folder(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        path: Path = tmp_path_factory.mktemp("wan")
        wan_image_pipeline(scheduler=unipc()).save_pretrained(path, safe_serialization=True)
        return path

    def copy(self, folder: Path, to: Path) -> Path:
        for source in folder.rglob("*"):
            if source.is_file():
                target = to / source.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())
        return to

    def test_wan_folder_loads_and_samples_as_the_pipeline_it_was(self, folder: Path) -> None:
        loaded = load_public_model(folder, negative_prompt="left")
        assert isinstance(loaded.velocity, WanVelocity) and loaded.velocity.fused
        assert loaded.shift == 5.0
        text, frames = embed_prompts(loaded.pipeline, ["push the cube"]), loaded.codec.encode(picture())
        model = WanVelocity(wan_transformer(), loaded.velocity.null_text, fused=True)
        for cfg in (1.0, 4.0):
            args = (NOISE, torch.tensor([0.5]), given(frames, text), cfg)
            assert torch.equal(guided_velocity(loaded.velocity, *args), guided_velocity(model, *args))

    def test_the_doctor_passes_it_with_and_without_an_adapter_and_refuses_a_folder_that_is_none(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        small = ["--size", "32x32", "--frames", "5", "--rollout.num_steps", "3", "--grpo.kl.anchor", "buffer"]
        for more in ([], ["--lora-rank", "2"]):
            assert main(["check-video-model", "--public", str(folder), *small, *more]) == 0, capsys.readouterr().out
        assert main(["check-video-model", "--public", str(tmp_path), *small]) == 2
        assert str(tmp_path) in capsys.readouterr().err

    def test_the_documented_training_runs_as_written_and_its_adapter_loads(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        scope = run_documented(folder, tmp_path, "cpu", "bfloat16")
        printed = r"\d [\d.]+ \[.+, .+\] \d+ s, 0\.0 GiB"
        assert all(re.fullmatch(printed, line) for line in capsys.readouterr().out.splitlines()[-2:])
        assert scope["report"].kept == 4 and scope["learner"].version == 4
        trained = {name: p for name, p in scope["public"].velocity.named_parameters() if "lora_B" in name}
        (file,) = tmp_path.glob("*.safetensors")
        adapter = {f"transformer.{name}": p for name, p in load_file(file).items()}
        assert trained and all(torch.equal(adapter[name.replace(".default", "")], p) for name, p in trained.items())
        assert any(float(p.detach().abs().max()) > 0 for p in trained.values()), "it starts as zeros"

    def test_wan_text_to_video_refuses_the_first_frames_and_trains_without_them(self, tmp_path: Path) -> None:
        wan_pipeline(scheduler=unipc()).save_pretrained(tmp_path / "t2v", safe_serialization=True)
        with pytest.raises(ValueError, match=r"text alone and takes no given frames, got 1; .*without_frames\(\)"):
            run_documented(tmp_path / "t2v", tmp_path, "cpu", "float32")
        scope = run_documented(tmp_path / "t2v", tmp_path, "cpu", "float32", text_only=True)
        assert scope["learner"].version == 4 and scope["clips"].condition.num_conditioning == 0

    def test_bfloat16_and_checkpointing(self, folder: Path) -> None:
        loaded = load_public_model(folder, dtype="bfloat16", gradient_checkpointing=True)
        assert embed_prompts(loaded.pipeline, ["push"]).dtype == torch.bfloat16
        assert loaded.codec.vae.dtype == torch.float32, "the VAE keeps its own"
        assert loaded.velocity.transformer.patch_embedding.weight.dtype == torch.bfloat16
        frames = loaded.codec.encode(picture())
        text = embed_prompts(loaded.pipeline, ["push"])
        out = loaded.velocity(NOISE, torch.tensor([0.5]), given(frames, text), torch.tensor([True]))
        assert bool(out.isfinite().all())
        out.square().sum().backward()

    def test_a_cosmos_folder_loads(self, tmp_path: Path) -> None:
        pipeline = cosmos25_pipeline(transformer=cosmos_transformer(concat_padding_mask=True, text_embed_dim=32))
        pipeline.register_modules(safety_checker=None)
        pipeline.save_pretrained(tmp_path, safe_serialization=True)
        loaded = load_public_model(tmp_path)
        assert isinstance(loaded.velocity, CosmosVelocity)
        condition = given(loaded.codec.encode(picture()), embed_prompts(loaded.pipeline, ["push"]))
        t = torch.tensor([0.5])
        assert bool(guided_velocity(loaded.velocity, NOISE, t, condition, 2.0).isfinite().all())

    def test_incomplete_folders_are_named_with_a_remedy(self, folder: Path, tmp_path: Path) -> None:
        def refused(match: str, path: Path) -> None:
            with pytest.raises(ModelFolderError, match=match) as caught:
                load_public_model(path)
            assert str(path) in str(caught.value)

        refused("model_index.json is missing", tmp_path / "nowhere")
        cannot = {part: f"{part} cannot be loaded" for part in ("transformer", "text_encoder", "tokenizer")}
        missing = {
            "model_index.json": "is missing", "scheduler/scheduler_config.json": "is missing",
            "transformer/config.json": cannot["transformer"], "tokenizer/tokenizer.json": cannot["tokenizer"],
            "text_encoder/config.json": cannot["text_encoder"],
        }
        for removed, match in missing.items():
            broken = self.copy(folder, tmp_path / removed.replace("/", "_"))
            (broken / removed).unlink()
            refused(match, broken)
        weights = "diffusion_pytorch_model.safetensors"
        pickled = self.copy(folder, tmp_path / "pickled")
        (pickled / "transformer" / weights).rename(pickled / "transformer" / "diffusion_pytorch_model.bin")
        refused("transformer cannot be loaded", pickled)
        short = self.copy(folder, tmp_path / "short")
        (short / "vae" / weights).write_bytes((folder / "vae" / weights).read_bytes()[:2000])
        refused("cannot be loaded as AutoencoderKLWan", short)

    def test_missing_weights_shards_and_other_models_are_refused(self, folder: Path, tmp_path: Path) -> None:
        from safetensors.torch import save_file

        part, weights = "transformer", "diffusion_pytorch_model.safetensors"
        lacking = self.copy(folder, tmp_path / "lacking")
        tensors = load_file(lacking / part / weights)
        tensors.pop("proj_out.weight")
        save_file(tensors, lacking / part / weights, {"format": "pt"})
        with pytest.raises(ModelFolderError, match=r"lacks 1 weights .* proj_out.weight"):
            load_public_model(lacking)
        shard = self.copy(folder, tmp_path / "shard")
        index = {"metadata": {}, "weight_map": {"proj_out.weight": "model-00002-of-00002.safetensors"}}
        (shard / part / f"{weights}.index.json").write_text(json.dumps(index))
        with pytest.raises(ModelFolderError, match="model-00002-of-00002"):
            load_public_model(shard)
        other = self.copy(folder, tmp_path / "other")
        (other / "model_index.json").write_text(json.dumps({"_class_name": "LTXPipeline"}))
        with pytest.raises(ModelFolderError, match="LTXPipeline; supported are WanPipeline"):
            load_public_model(other)
        slow = self.copy(folder, tmp_path / "slow")
        scheduler = json.loads((slow / "scheduler" / "scheduler_config.json").read_text())
        (slow / "scheduler" / "scheduler_config.json").write_text(json.dumps({**scheduler, "num_train_timesteps": 500}))
        with pytest.raises(ModelFolderError, match="num_train_timesteps 500; Wan is supported with 1000"):
            load_public_model(slow)
        index = json.loads((folder / "model_index.json").read_text())
        index["transformer_2"] = index["transformer"]
        (other / "model_index.json").write_text(json.dumps(index))
        with pytest.raises(ModelFolderError, match="two experts"):
            load_public_model(other)


class TestDevice:
    """Public models on a device as on the CPU."""

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["wan", "cosmos2.5"])
    def test_a_lora_is_trained_by_the_documented_lines_as_on_the_cpu(
        self, device: Device, kind: str, tmp_path: Path
    ) -> None:
        projected = {
            "use_crossattn_projection": True, "crossattn_proj_in_channels": 32, "encoder_hidden_states_channels": E
        }
        pipeline = wan_image_pipeline() if kind == "wan" else cosmos25_pipeline(
            transformer=cosmos_transformer(text_embed_dim=E, **projected)
        )
        if kind != "wan":
            pipeline.register_modules(safety_checker=None)
        pipeline.save_pretrained(tmp_path / "model", safe_serialization=True)
        plain = run_documented(tmp_path / "model", tmp_path / "cpu", "cpu", "float32")
        there = run_documented(tmp_path / "model", tmp_path / "device", device.name, "float32")
        assert device.counts is None or device.counts.kernels > 10_000
        buffer = there["clips"]
        assert buffer.condition.frames.device.type == buffer.rollout.states.device.type == "cpu", "the preset's"
        assert there["contexts"].text.device.type == there["public"].velocity.null_text.device.type == "cuda"
        assert there["contexts"].text.shape[2] == E, "projected once"
        assert there["learner"].version == 4 and plain["report"].kept == there["report"].kept == 4
        assert there["report"].reward_mean == pytest.approx(plain["report"].reward_mean, rel=1e-4)
        files = [path.relative_to(tmp_path / "cpu") for path in (tmp_path / "cpu").rglob("*.safetensors")]
        for file in files:
            wanted = load_file(tmp_path / "cpu" / file)
            for name, tensor in load_file(tmp_path / "device" / file).items():
                assert_close(tensor, wanted[name], rtol=1e-4, atol=1e-6 if device.counts else 5e-3)
        assert files


class TestOptionalPackages:
    def test_video_model_and_adapters_import_none_of_them(self) -> None:
        code = (
            "import sys, wm_nodes.video_model, wm_nodes.video_model.adapters\n"
            "assert not {'diffusers', 'transformers', 'peft', 'accelerate'} & set(sys.modules)"
        )
        subprocess.run([sys.executable, "-c", code], check=True)

    def test_a_missing_one_is_named_with_the_pip_command(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setitem(sys.modules, "diffusers", None)
        with pytest.raises(MissingPackageError, match=r"package diffusers.*pip install .* requirements/video.txt"):
            load_public_model(tmp_path)


class TestWhatIsNotSupported:
    def test_models_that_want_more_are_named(self) -> None:
        with pytest.raises(ValueError, match="CLIP"):
            WanVelocity(wan_transformer(image_dim=8, added_kv_proj_dim=24))
        with pytest.raises(ValueError, match="image context"):
            CosmosVelocity(cosmos_transformer(img_context_dim_in=8, img_context_dim_out=24))
        with pytest.raises(ValueError, match="further channels"):
            WanVelocity(wan_transformer(in_channels=2 * C + 4))
        with pytest.raises(ValueError, match="text alone"):
            WanVelocity(wan_transformer())(NOISE, torch.tensor([0.5]), given(normal(1, C, 1, SIDE, SIDE)))
        with pytest.raises(ValueError, match="grid of multiples"):
            WanVelocity(wan_transformer())(NOISE[..., :3], torch.tensor([0.5]), given())
