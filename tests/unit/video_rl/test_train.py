"""The loop of video-model RL on one screen: what it does, buffer by buffer, and that it fits a screen."""

from pathlib import Path

import torch
from video_toys import weights

from wm_nodes.config.load import load_video_config
from wm_nodes.video_rl import train
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.toy_scene import ToyContexts, draw_scenes, load_base, score
from wm_nodes.video_rl.train import post_train, sample_buffers

CONFIG = load_video_config("base", {
    "groups.contexts": 2, "groups.group_size": 3, "rollout.num_steps": 4, "rollout.shift": 3.0,
    "rollout.sampler.arm": "cps", "grpo.learning_rate": 1e-4, "grpo.logprob_weight": "cps",
})


def make_learner() -> tuple[ToyContexts, GrpoLearner]:
    source = ToyContexts(load_base(), CONFIG)
    return source, GrpoLearner(source.network, CONFIG.grpo, CONFIG.rollout, seed=CONFIG.seed)


def test_each_buffer_is_sampled_by_the_newest_weights_scored_and_trained_on() -> None:
    (source, learner), (other, same) = make_learner(), make_learner()
    found = list(post_train(learner, sample_buffers(source, learner, 2)))
    assert [(buffer.iteration, buffer.policy_version) for buffer, _ in found] == [(0, 0), (1, 2)]
    for iteration, (buffer, report) in enumerate(found):
        request = other.request(iteration, same.version)
        again = other.score(request, other.sample(request))
        assert torch.equal(buffer.rollout.latents, again.rollout.latents)
        assert same.train(again).reward_mean == report.reward_mean == float(buffer.rewards["total"].mean())
    for name, weight in weights(source.network).items():
        assert torch.equal(weight, weights(other.network)[name])


def test_a_group_of_the_toy_is_several_videos_of_one_scene_scored_from_their_pixels() -> None:
    source, _ = make_learner()
    request = source.request(3, 0)
    buffer = source.score(request, source.sample(request))
    assert buffer.group_ids.tolist() == [0, 0, 0, 1, 1, 1] and buffer.sample_ids.tolist() == [0, 1, 2, 0, 1, 2]
    scenes = draw_scenes(2, CONFIG.seed, "rollouts", 3).rows(buffer.group_ids)
    assert torch.equal(buffer.rewards["total"], score(buffer.rollout.latents, scenes)["reward"])
    assert torch.equal(buffer.rewards["obeyed"], score(buffer.rollout.latents, scenes)["obeyed"])
    assert not torch.equal(buffer.rollout.latents[0], buffer.rollout.latents[1])


def test_the_loop_fits_one_screen() -> None:
    assert len(Path(str(train.__file__)).read_text().splitlines()) <= 60
