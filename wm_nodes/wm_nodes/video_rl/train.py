"""Loop 2 on one screen: GRPO of a video model on groups of its own clips. The learner node runs it on clips of other
processes, with the same weights bit for bit (tests/graph/test_world_model_rl.py). `python -m wm_nodes.video_rl.train`
takes seconds per buffer: a disc goes as commanded in 57 % of clips, then in two of three."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

from wm_nodes.config.load import load_video_config
from wm_nodes.core.device import compute_device
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_rl.grpo import BufferReport, GrpoLearner
from wm_nodes.video_rl.toy_scene import ToyContexts, draw_scenes, load_base

Request = TypeVar("Request")


class ClipSource(Protocol[Request]):
    """Where contexts come from, how clips of them are sampled, and what a clip is worth."""

    def request(self, iteration: int, policy_version: int) -> Request: ...
    def sample(self, request: Request) -> RolloutBuffer: ...
    def score(self, request: Request, clips: RolloutBuffer) -> RolloutBuffer: ...


class VideoLearner(Protocol):
    """GrpoLearner, or a VideoRun, which also writes versions, checkpoints and metrics."""

    @property
    def version(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    def train(self, buffer: RolloutBuffer) -> BufferReport: ...


def post_train(learner: VideoLearner, buffers: Iterable[RolloutBuffer]) -> Iterator[tuple[RolloutBuffer, BufferReport]]:
    """Train on each buffer as it comes; yield it with the report of its optimizer steps."""
    for buffer in buffers:
        yield buffer, learner.train(buffer)  # learner.version is new from here on


def sample_buffers(source: ClipSource[Request], learner: VideoLearner, count: int) -> Iterator[RolloutBuffer]:
    """Buffers of fresh clips with their rewards, each sampled when it is asked for."""
    for _ in range(count):
        request = source.request(learner.iterations, learner.version)  # which contexts, and which weights sample
        clips = source.sample(request)  # a group of clips of each context
        yield source.score(request, clips)  # a clip without reward is left out


def main() -> None:
    changes = {"groups.contexts": 6, "groups.shared_noise": True, "rollout.shift": 3.0, "rollout.sampler.arm": "cps"}
    config = load_video_config("base", {**changes, "grpo.learning_rate": 1e-4, "grpo.logprob_weight": "cps"})
    source = ToyContexts(load_base(device=compute_device(config.device)), config)
    learner = GrpoLearner(source.network, config.grpo, config.rollout, seed=config.seed)
    for iteration, (_, report) in enumerate(post_train(learner, sample_buffers(source, learner, 20)), 1):
        obeyed = source.evaluate(draw_scenes(100, config.seed, "evaluation"))["obeyed"].mean()
        print(f"buffer {iteration}: training reward {report.reward_mean:.2f}; {obeyed:.0%} of held-out clips obey")


if __name__ == "__main__":
    main()
