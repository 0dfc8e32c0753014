"""Loop 2 at toy size, on a device and on the CPU: the same numbers, to the bit on a pretended device, and no more waits
for it than there must be.

A forgotten move between the CPU and the device, in any of these paths, is refused by the pretended device.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from device_counts import WAITS
from model_folders import make_model_folder
from pretended_device import Device
from torch import Tensor
from torch.testing import assert_close
from video_toys import ACTION_DIM, tiny_network, toy_buffer, toy_clips, toy_rollout_settings

from benchmarks.video_rl.cost import toy_rollout
from benchmarks.video_rl.discs import training_batch
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import DeviceError, device_of
from wm_nodes.core.seeding import torch_stream
from wm_nodes.core.specs import spec_of_values
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.judge.service import buffer_jobs
from wm_nodes.nodes.video_model_node import film_strip
from wm_nodes.video_model import NetworkSettings, VideoNetwork
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.flow_matching import train_video_model
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_model.tokenizer_codec import codec_of_world_model
from wm_nodes.video_rl.execution_reward import make_execution_reward
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.pretraining import make_video_model
from wm_nodes.video_rl.sampling import RecordedContexts, sample_by_ode
from wm_nodes.video_rl.toy_scene import NETWORK, ToyContexts, draw_scenes, load_base
from wm_nodes.video_rl.train import post_train, sample_buffers
from wm_nodes.video_rl.training_run import VideoRun, progress
from wm_nodes.video_rl.validation import context_scores
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.position_probe import PositionProbe

TOY = {
    "groups.contexts": 2, "groups.group_size": 3, "rollout.num_steps": 4, "rollout.shift": 3.0,
    "rollout.micro_batch": 4, "grpo.learning_rate": 1e-3, "grpo.logprob_weight": "cps", "grpo.micro_batch": 5,
}
SMALL = {
    **TOY, "model.width": 16, "model.depth": 2, "model.batch_size": 2, "model.training.num_iterations": 4,
    "evaluation.contexts": 2, "evaluation.every": 1, "rewards": {"psnr_db": 1.0, "tracking": 1.0},
}
"""The preset gpu at a size for tests."""
NFT = {"grpo.objective": "nft", "grpo.kl.beta": 0.0}
Found = dict[str, Tensor]


def check_both(device: Device, work: Callable[[str], Found], *, exact: bool = True) -> None:
    """What `work`, told where, finds on the CPU and on the device must be the same.

    exact: to the bit on a pretended device. A real one rounds otherwise, and Adam's first steps enlarge that.
    """
    plain, found = work("cpu"), work(device.name)
    assert device.counts is None or device.counts.kernels > 500, "little was computed on the device"
    assert plain.keys() == found.keys()
    limits = (5e-2, 1e-2) if device.counts is None else (0.0, 0.0) if exact else (1e-4, 1e-5)
    for name, wanted in plain.items():
        if wanted.dtype == torch.uint8 and not (exact and device.counts):  # rounded once more
            close = (found[name].int() - wanted.int()).abs() <= 1
            assert float(close.float().mean()) > 0.9 if device.counts is None else bool(close.all()), name
        else:
            text = partial("{}: {}".format, name)
            assert_close(found[name], wanted, rtol=limits[0], atol=limits[1], equal_nan=True, msg=text)


def weights_of(network: torch.nn.Module) -> Found:
    return {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}


def as_bytes(data: bytes) -> Tensor:
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def test_flow_matching_learns_the_same_weights_and_goes_on_from_a_checkpoint(device: Device, tmp_path: Path) -> None:
    settings = load_video_config("smoke").model.training.with_values(drop=0.3)

    def work(where: str) -> Found:
        torch.manual_seed(0)
        network = VideoNetwork(NETWORK).to(where)
        for iterations in (3, 6):
            part = settings.with_values(num_iterations=iterations)
            train_video_model(network, lambda i: training_batch(4, 0, i), part, seed=0, run_dir=tmp_path / where)
        assert str(device_of(network)).startswith(where)
        return weights_of(network)

    check_both(device, work)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"grpo.kl.anchor": "dual", "grpo.kl.dual_every": 1},
        {"rollout.buffer_device": "cpu", "grpo.kl.anchor": "frozen", "rollout.storage_dtype": "bfloat16"},
        {"rollout.sampler.arm": "flow", "rollout.cfg": 2.0},
        {"rollout.sampler.arm": "sage", "rollout.buffer_device": "cpu"},
        {**NFT, "rollout.sampler.arm": "ode"},
        {**NFT, "rollout.buffer_device": "cpu", "grpo.kl.beta": 0.0},
    ],
    ids=["dual", "host", "flow", "sage", "nft", "nft, host"],
)
def test_the_toy_is_sampled_scored_trained_saved_and_evaluated_alike(
    device: Device, changes: dict[str, Any], tmp_path: Path
) -> None:
    config = load_video_config("base", {**TOY, **changes})

    def learner_of(source: ToyContexts) -> GrpoLearner:
        return GrpoLearner(source.network, config.grpo, config.rollout, seed=config.seed)

    def work(where: str) -> Found:
        source, found, path = ToyContexts(load_base(device=where), config), {}, tmp_path / f"{where}.safetensors"
        learner = learner_of(source)
        for iteration, (buffer, report) in enumerate(post_train(learner, sample_buffers(source, learner, 2))):
            place = where if config.rollout.buffer_device == "model" else "cpu"
            assert buffer.rollout.states.device.type == buffer.condition.frames.device.type == place
            assert buffer.rewards["total"].device.type == buffer.valid.device.type == "cpu"
            if device.counts is not None:
                found[f"buffer {iteration}"] = as_bytes(buffer.to_bytes())
            numbers = [value for update in report.updates for value in list(vars(update).values())[:7]]
            found[f"report {iteration}"] = torch.tensor([*numbers, report.reward_mean, report.noise_share])
            learner.save(path)
        again = learner_of(ToyContexts(load_base(device=where), config))
        again.load(path)
        assert again.iterations == 2
        found |= {name: value.cpu() for name, value in source.evaluate(draw_scenes(3, 0, "evaluation")).items()}
        following = [source.score(request, source.sample(request)) for request in [source.request(2, learner.version)]]
        for one in (learner, again):
            one.train(following[0])
        for name, weight in weights_of(source.network).items():
            assert torch.equal(weight, weights_of(again.model)[name]), "a resumed learner goes on otherwise"
        return found | weights_of(source.network)

    check_both(device, work)


def test_a_failed_update_leaves_the_weights_as_they_were_and_copies_none_to_the_host(device: Device) -> None:
    settings, network = toy_rollout_settings(), tiny_network().to(device.name)
    learner = GrpoLearner(network, load_video_config("smoke").grpo, settings, seed=0)
    learner.train(toy_buffer(tiny_network(), settings).to(device.name))
    before, version = weights_of(network), learner.version
    broken = toy_buffer(tiny_network(), settings, version=version, iteration=1)
    broken.rollout.states.fill_(torch.nan)
    broken = broken.to(device.name)
    if device.counts is not None:
        device.counts.reset()
    with pytest.raises(FloatingPointError, match="not finite"):
        learner.train(broken)
    if device.counts is not None:
        assert device.counts.bytes_down < 2000 < sum(weight.nbytes for weight in before.values())
    after = weights_of(network)
    assert learner.version == version and all(torch.equal(after[name], weight) for name, weight in before.items())


def test_an_optimizer_step_waits_for_the_device_only_to_report_and_to_see_that_it_is_finite(device: Device) -> None:
    if device.counts is None:
        pytest.skip("a real device does not count")
    settings = toy_rollout_settings()
    grpo = load_video_config("base").grpo.with_values(updates_per_buffer=1, micro_batch=4, step_fraction=1.0)
    learner = GrpoLearner(tiny_network().to(device.name), grpo, settings, seed=0)
    buffer = toy_buffer(tiny_network(), settings).to(device.name)
    device.counts.reset()
    (update,) = learner.train(buffer).updates
    calls, waits = -(-update.transitions // 4), device.counts.by_kind(WAITS)
    reports = 3  # the noise that the buffer spent, in all and by step, and what the optimizer step logs
    assert calls > 5 and waits.total() <= 1 + reports, device.counts.report()
    assert device.counts.copies_up <= 10 * calls + 2, device.counts.report()


def clips(count: int, seed: int, height: int = 16, width: int = 32) -> Clips:
    generator = torch_stream(seed, "test_device_clips")
    frames = torch.randint(0, 256, (count, 3, height, width, 3), generator=generator, dtype=torch.uint8)
    frames[:, :, 0] = 0  # scenery
    actions = torch.randn(count, 2, ACTION_DIM, generator=generator)
    truth = torch.rand(count, 3, len(GROUND_TRUTH_NAMES), generator=generator).numpy()
    return toy_clips(frames, actions, truth, ("push the cube",) * count)


def probe_on(device: str, height: int = 16, width: int = 32) -> PositionProbe:
    torch.manual_seed(1)
    return PositionProbe(height, width).to(device).eval()


def small_config(device: str, **changes: Any) -> VideoRlConfig:
    return load_video_config("gpu", {**SMALL, "device": device, **changes})


def test_the_preset_gpu_trains_a_video_model_and_post_trains_it_in_a_run_folder(device: Device, tmp_path: Path) -> None:
    """From clips to versions, checkpoints and held-out scores, stopped once and resumed."""
    contexts, heldout = clips(6, 0), clips(3, 1)

    def work(where: str) -> Found:
        config, run_dir = small_config(where), tmp_path / where
        folder = make_video_model(config, contexts, heldout, probe_on(where), run_dir)
        found = {f"pretrained {name}": value for name, value in weights_of(folder.network).items()}
        for buffers in (1, 2):
            model = load_video_folder(run_dir / "video_model", where)

            def scores(model: VideoFolder = model) -> dict[str, float]:
                of = context_scores(model, heldout, probe_on(where), config)
                return {name: float(value.mean()) for name, value in of.items()}

            run = VideoRun(model.network, config, run_dir, heldout=scores)
            source = RecordedContexts(model, contexts, config, probe_on(where))
            while run.iterations < buffers:
                request = source.request(run.iterations, run.version)
                run.train(source.score(request, source.sample(request)))
            run.close()
        assert progress(run_dir) == (2, 2) and device_of(run.network).type == where
        shown = sample_by_ode(model, heldout, config, 3).cpu()
        assert shown.float().std() > 1
        return found | weights_of(run.network) | {"shown": shown}

    check_both(device, work)


def test_clips_of_the_tokenizer_are_scored_shown_and_judged_from_the_device(device: Device, tmp_path: Path) -> None:
    world_model, contexts = make_model_folder(tmp_path / "world_model"), clips(3, 0, 64, 128)

    def work(where: str) -> Found:
        codec = codec_of_world_model(world_model).to(where)
        torch.manual_seed(0)
        network = VideoNetwork(NetworkSettings(codec.channels, ACTION_DIM, 4, width=16, depth=1, patch=1)).to(where)
        config = small_config(where, **{"rollout.buffer_device": "cpu"})  # as what arrives from another process
        folder = VideoFolder(codec, network.eval(), {"stride": 1, "num_conditioning": 1}, {})
        source = RecordedContexts(folder, contexts, config, probe_on(where, 64, 128))
        request = source.request(0, 0)
        buffer = source.score(request, source.sample(request))
        frames, references = codec.decode(buffer.rollout.latents), source.references(request)
        strip = film_strip(frames)
        jobs = buffer_jobs(frames, references, "0" * 64, config, given=1, fps=5.0)
        assert all(value.device.type == "cpu" for value in buffer.rewards.values())
        return {
            **{name: value.cpu() for name, value in buffer.rewards.items()},
            "strip": torch.from_numpy(strip.copy()),
            "judged": torch.from_numpy(np.stack([job.clip.frames for job in jobs])),
        }

    check_both(device, work, exact=False)  # the tokenizer's batches are of another size


def test_the_network_of_the_preset_gpu_has_between_8_and_30_million_parameters() -> None:
    config = load_video_config("gpu")
    with torch.device("meta"):
        network = VideoNetwork(NetworkSettings(24, 6, config.model.text_dim, config.model.width, config.model.depth))
    assert config.device == "cuda" and config.groups.contexts * config.groups.group_size == 2048
    assert 8e6 < sum(parameter.numel() for parameter in network.parameters()) < 30e6


def test_the_check_of_a_video_model_passes_on_the_device(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-video-model", "--preset", "smoke", "--device", device.name]) == 0, capsys.readouterr().out
    assert device.counts is None or device.counts.kernels > 1000


def test_the_benchmarks_measure_on_the_device(device: Device, tmp_path: Path) -> None:
    found = toy_rollout(load_base(device=device.name), repeats=1, seed=0)
    assert 0 < found["mask_share"] < 1
    assert device.counts is None or device.counts.by_kind(WAITS)["synchronize"] > 20, "launches were timed"
    sizes = ["--iterations", "1", "--scenes", "1", "--eval-scenes", "2", "--seeds", "0", "--samplers", "CPS 0.6"]
    more = ["--device", device.name, "--json", str(tmp_path / "rows.json")]
    assert main(["benchmark", "learning", *sizes, *more]) == 0
    (row,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert row["seconds"]["train"] > 0 and len(row["after"]["obeyed"]) == 2


def test_too_little_memory_for_clips_or_for_an_update_names_what_to_lower_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config("cpu")
    source = ToyContexts(load_base(), config)
    request = source.request(0, 0)
    buffer, before = source.score(request, source.sample(request)), weights_of(source.network)
    run = VideoRun(source.network, config, tmp_path)

    def full(*arguments: Any) -> Tensor:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")

    monkeypatch.setattr(VideoNetwork, "forward", full)
    with pytest.raises(DeviceError, match=r"lower rollout.micro_batch from 4 to 2, groups.contexts from 2 to 1"):
        source.sample(request)
    with pytest.raises(DeviceError, match=r"lower grpo.micro_batch from 5 to 2"):
        run.train(buffer)
    run.close()
    assert all(torch.equal(weights_of(source.network)[name], weight) for name, weight in before.items())
    assert (run.version, run.iterations) == (0, 0)


def test_an_action_world_model_pays_clips_where_the_video_model_is(device: Device) -> None:
    world = shipped_model("push_cube")
    shown, recordings = clips(3, 0, 64, 128), clips(4, 1, 64, 128)
    states = recordings.ground_truth[..., 4:7] + np.float32([0.6, 0, 0])
    spec = spec_of_values(read_world_manifest(world)["spec"])
    recordings = replace(recordings, states=states, spec=spec)

    def work(where: str) -> Found:
        config = small_config(where, rewards={"execution": 1.0})
        folder = load_video_folder(world / "video_model_outcome", where)
        reward = make_execution_reward(config, folder, recordings, probe_on(where, 64, 128))
        assert device_of(folder.network).type == where
        return reward.score(shown.frames.to(where), recordings.select(torch.arange(3)))

    check_both(device, work)
