"""A tiny loop 2: recorded contexts, an untrained video model, its nodes on a graph, and the loop in one process."""

import signal
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from graph.harness import Graph, Probe, wait_until
from recording_samples import make_episode, make_spec
from video_toys import small_codec

from wm_msgs.action import TrainVideo
from wm_nodes.config.load import dump_config, load_video_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.training.weights import load_weights, pack_weights
from wm_nodes.video_model import NetworkSettings, RolloutBuffer, VideoNetwork
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.video_rl.train import post_train, sample_buffers
from wm_nodes.video_rl.training_run import VIDEO_FILES

EPISODES, STEPS, STRIDE = 4, 4, 2
ITERATIONS = 1000
"""More than any test makes."""
BLIND = 3
"""The context without simulator state: its clips cannot be judged."""
MODEL_DIR = Path(str(shipped_model("push_cube")))
NAMES = {"video_model": "/wm/video_model", "clip_evaluator": "/wm/reward_evaluator", "video_learner": "/wm/learner"}
"""Node module to the node's name in the graph."""


def settings(**overrides: Any) -> VideoRlConfig:
    """Two groups of three clips, sampled one by one in more steps than are trained on, so that sampling can be met."""
    values = {
        "groups.contexts": 2, "groups.group_size": 3, "rollout.num_steps": 16, "rollout.micro_batch": 1,
        "window.strategy": "progressive", "window.size": 3, "window.period": 1, "grpo.learning_rate": 1e-3,
        "evaluation.every": 0, "rewards": {"tracking": 1.0, "psnr_db": 0.1},
    }
    return load_video_config("smoke", {**values, **overrides})


def write_contexts(path: Path) -> Path:
    """A bag of episodes whose picture stands still; BLIND has no simulator state (NaN)."""
    spec = make_spec(height=64, width=128)
    with EpisodeBagWriter(path, spec, run_id="contexts", start_ns=1) as bag:
        for index in range(EPISODES):
            episode = make_episode(spec, index, STEPS)
            truth = np.full_like(episode.ground_truth, np.nan if index == BLIND else 0.1)
            images = np.repeat(episode.images[:1], STEPS + 1, axis=0)
            bag.write(replace(episode, images=images, ground_truth=truth))
    return path


def make_video_folder(folder: Path, clips: Clips, config: VideoRlConfig | None = None) -> Path:
    """A codec and a network that were not trained; the zeros that the network starts with are replaced."""
    codec = small_codec(4, 64, 128)
    codec.tokenizer.background.fill_(0.75)  # too bright: what makes pictures worse is one direction, soon learned
    generator = torch.Generator().manual_seed(0)
    network = VideoNetwork(NetworkSettings(6, clips.actions.shape[2], text_dim=4, width=16, depth=1))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    clip = {"stride": STRIDE, "num_conditioning": 1}
    if config is not None and config.model.training.given_frames:
        clip |= {name: getattr(config.model.training, name) for name in ("given_frames", "new_frames")}
    return save_video_folder(folder, codec, network, clip, {"seed": 0})


class LocalLoop:
    """The training of the graph by video_rl/train.py, in this process, as far as it is asked for."""

    def __init__(self, config: VideoRlConfig, folder: Path, bag: Path) -> None:
        torch.set_num_threads(1)
        self.config = config
        self._source = RecordedContexts(
            load_video_folder(folder), load_clips([bag], STRIDE), config, load_probe(MODEL_DIR)
        )
        self._network = load_video_folder(folder).network
        self._learner = GrpoLearner(self._network, config.grpo, config.rollout, seed=config.seed)
        self._training = post_train(self._learner, sample_buffers(self, self._learner, ITERATIONS))
        self._files = [self._packed()]
        self.versions = [0]
        """Before each iteration that was made, and now."""
        self.invalid = [0]
        """Clips without reward in so many iterations."""

    def weights(self, iterations: int) -> bytes:
        """The file of the version that so many iterations make."""
        while len(self._files) <= iterations:
            buffer, _ = next(self._training)
            self._files.append(self._packed())
            self.versions.append(self._learner.version)
            self.invalid.append(self.invalid[-1] + int((~buffer.valid).sum()))
        return self._files[iterations]

    def buffer(self, iteration: int, after: int, config: VideoRlConfig | None = None) -> RolloutBuffer:
        """The judged clips of an iteration, sampled by the weights that `after` iterations make."""
        source = copy(self._source)
        source.config = config or self.config
        load_weights(source.folder.network, self.weights(after))
        request = source.request(iteration, self.versions[after])
        return source.score(request, source.sample(request))

    # What video_rl.train.ClipSource is, with a network of its own.

    def request(self, iteration: int, policy_version: int) -> GroupRequest:
        load_weights(self._source.folder.network, self.weights(iteration))
        return self._source.request(iteration, policy_version)

    def sample(self, request: GroupRequest) -> RolloutBuffer:
        return self._source.sample(request)

    def score(self, request: GroupRequest, clips: RolloutBuffer) -> RolloutBuffer:
        return self._source.score(request, clips)

    def _packed(self) -> bytes:
        return pack_weights(self._network, {"version": str(self._learner.version)}).data


class VideoLoop:
    """The nodes of loop 2 on a graph, over files in `graph.folder`."""

    def __init__(self, graph: Graph, probe: Probe, config: VideoRlConfig) -> None:
        self.graph, self.probe, self.config = graph, probe, config
        self.bag = write_contexts(graph.folder / "contexts")
        self.model = make_video_folder(graph.folder / "video_model", load_clips([self.bag], STRIDE), config)
        (graph.folder / "video_config.yaml").write_text(dump_config(config), encoding="utf-8")
        self.local = LocalLoop(config, self.model, self.bag)
        self.links = probe.links()

    def start(self, node: str, **params: Any) -> None:
        """Start one of NAMES; its parameters may be replaced."""
        values: dict[str, Any] = {
            "config_file": self.graph.folder / "video_config.yaml", "video_model_dir": self.model
        }
        if node != "video_learner":
            values["context_bags"] = f"['{self.bag}']"
        if node == "clip_evaluator":
            values["model_dir"] = MODEL_DIR
        self.probe.diagnostics.pop(NAMES[node], None)
        self.graph.start(node, **{**values, **params})

    def wait_active(self, *nodes: str) -> None:
        """Wait until the nodes are active, and none of them is lost to the learner any more."""
        for node in nodes or NAMES:
            wait_until(f"active {node}", lambda n=node: self.probe.value(NAMES[n], "state") == "active")
            wait_until(f"a learner that hears {node}", lambda n=node: not self._lost(NAMES[n]))

    def _lost(self, name: str) -> bool:
        learner = self.probe.diagnostics.get("/wm/learner")
        return learner is not None and f"{name} is lost" in learner.message

    def restart(self, node: str) -> None:
        """Start a killed node again; return when it is active, matched, and not lost to the learner any more."""
        others = [name for name in NAMES.values() if name != NAMES[node]]
        self.graph.restart(lambda: self.start(node), self.links, NAMES[node], *others, process=f"/wm/{node}")
        self.wait_active(node)

    def stop(self, node: str) -> None:
        """SIGINT, as a person would."""
        process = self.graph.processes[f"/wm/{node}"]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0

    def train(self, iterations: int = 0, **goal: Any) -> TrainVideo.Result:
        return self.probe.finish(self.send(iterations, **goal))

    def send(self, iterations: int = 0, feedback: Any = None, **goal: Any) -> Any:
        client = self.probe.action(TrainVideo, "video/train")
        return self.probe.send(client, TrainVideo.Goal(iterations=iterations, **goal), feedback)

    def cancel(self, handle: Any) -> TrainVideo.Result:
        return self.probe.cancel(handle)

    def newest(self, result: TrainVideo.Result) -> bytes:
        """The weights file of a result's version."""
        return (self.graph.folder / VIDEO_FILES.uri(result.policy_version)).read_bytes()

    def assert_undisturbed(self, result: TrainVideo.Result) -> None:
        """Assert that the goal finished, with the weights of the loop in this process, bit for bit."""
        assert result.termination_reason == TrainVideo.Result.FINISHED, result.message
        assert self.newest(result) == self.local.weights(result.iterations)
