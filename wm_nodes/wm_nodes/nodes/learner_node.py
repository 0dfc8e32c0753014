"""learner: asks the policy for rollouts, joins what the graph publishes about them, trains, announces new versions."""

import os
import signal
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image

from wm_msgs.action import Replay, Train
from wm_msgs.action import Rollout as RolloutAction
from wm_msgs.msg import EnvSpec, ErrorCode, RewardBatch, TransitionBatch
from wm_msgs.srv import GetWeights, SaveCheckpoint
from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import AGENT
from wm_nodes.core.errors import WireError, first_few
from wm_nodes.core.lockstep import DroppedTransitions
from wm_nodes.core.named_files import NamedFiles
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Environment, Rollout
from wm_nodes.judge.episode_reward import check_horizon, unjudged_reason
from wm_nodes.judge.service import TrainingPaused
from wm_nodes.nodes.factories import expected_spec, make_policy, refuse_other
from wm_nodes.nodes.learner.device_rollouts import DeviceRollouts
from wm_nodes.nodes.learner.meter import LearnerMeter
from wm_nodes.nodes.learner.report import LearnerReport
from wm_nodes.nodes.learner.rollout_assembler import RolloutAssembler
from wm_nodes.nodes.learner.rollout_sources import BagRollouts, LiveRollouts, ReplayedRollouts, RolloutSource, bag_paths
from wm_nodes.nodes.learner.training_node import TrainingNode
from wm_nodes.nodes.policy.weights import load_initial
from wm_nodes.policy_rl.factories import make_learner
from wm_nodes.policy_rl.rollouts import Canceled, TensorRollout
from wm_nodes.policy_rl.training_run import PolicyTraining
from wm_nodes.recording.messages import images_of, time_ns
from wm_nodes.recording.reader import read_spec
from wm_nodes.recording.rollouts import recorded_reward_name
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.actions import GuardedActionClient
from wm_nodes.ros.params import COMMON, Param, named_files, read_parameters
from wm_nodes.ros.sequence_numbers import check_session
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.worker import Work
from wm_nodes.training.ranks import Ranks, join, own_device
from wm_nodes.training.weights import INLINE_LIMIT_BYTES

MAX_CHUNK_BYTES = 4 << 20

PARAMS = (
    Param("model_dir", "", "World-model folder; its tokenizer is the policy's encoder", read_only=True),
    Param("initial_policy", "", "Weights (safetensors) to start from, where the run folder has no checkpoint",
          read_only=True),
    Param("resume", True, "Continue exactly from the run folder's checkpoint", read_only=True),
    Param("keep_versions", 20, "Weights files kept in run_dir/policies", minimum=1, maximum=100000, read_only=True),
    Param("tensorboard", False, "Write learner metrics to run_dir/tensorboard too; its import takes seconds",
          read_only=True),
    Param("join_timeout_s", 5.0, "How long a rollout's last images and rewards may take to arrive", "s",
          minimum=0.1, maximum=600.0),
    Param("starts_file", "", "First frames that are imagined from; for the exploit meter", read_only=True),
    Param("video_model_dir", "", "Video model that is trained in; for the exploit meter", read_only=True),
    Param("replay_at_start", "", "Bag that a player replays and that is trained from (ppo.updates) as soon as active",
          read_only=True),
    Param("replay_rate", 1.0, "Rate asked of the player: recorded seconds per second", minimum=1e-3, maximum=1e6),
    Param("recovery_timeout_s", 60.0, "How long a lost node may take to come back before training ends", "s",
          minimum=0.0, maximum=3600.0),
)


class LearnerNode(TrainingNode):
    """Action train; services learner/save, learner/get_weights; publishes policy/version, learner/metrics.

    Args:
        ranks: this process is rank 0 of them.
        local_environment: in a composed process, returns what the environment node serves; live rollouts are then made
            here, on the device.
    """

    inline_limit_bytes = INLINE_LIMIT_BYTES

    def __init__(
        self, ranks: Ranks | None = None, local_environment: Callable[[], Environment | None] | None = None,
        **node_arguments: Any,
    ) -> None:
        super().__init__(PARAMS, **node_arguments)
        self._ranks = ranks or Ranks()
        self._device_rollouts = None if local_environment is None else DeviceRollouts(local_environment)

    def configure(self) -> None:
        self.hold_run_folder()
        self._config = self.run_config()
        values = {param.name: self.param(param.name) for param in (*COMMON, *PARAMS)}
        self._files: NamedFiles = named_files(self, str(self.param("replay_at_start")))
        self._training = make_run(values, self.run_dir, self._ranks)
        self._report = LearnerReport(self, tensorboard=bool(self.param("tensorboard")))
        self.own(self._report.close)
        self._meter = LearnerMeter(self, self._config, self._training, self._report)
        self._spec: EnvironmentSpec | None = None
        self._spec_session = 0
        self._refused: WireError | None = None
        """Why the newest spec on env/spec cannot be trained from: it ends a goal that waits for its rollouts."""
        self._expected_spec = expected_spec(self._config, str(self.param("model_dir")))
        self._assembler, self._reward_name, self._max_episode_steps = RolloutAssembler(self._withhold), "", 0
        self.listen("env/spec", self._on_spec, while_inactive=True)
        self.listen("env/image", self._on_image)
        self._credit = self.listen("env/transition", self._on_transition, credit=True)
        self.listen("reward", self._on_reward)
        self.serve(SaveCheckpoint, "learner/save", self._on_save, counted="refused_saves")
        self.serve(GetWeights, "learner/get_weights", self._on_get_weights, counted="refused_weights")
        self._rollouts = GuardedActionClient(self, RolloutAction, "rollout")
        self.own(self._rollouts.destroy)
        self._replay = GuardedActionClient(self, Replay, "replay")
        self.own(self._replay.destroy)
        self.serve_training(self._training, Train, "train", "policy/version")

    def activate(self) -> None:
        self.announce()
        if self.param("replay_at_start"):
            self._train_from_replay(str(self.param("replay_at_start")))

    def cleanup(self) -> None:
        if hasattr(self, "_training"):
            self._training.close()
            del self._training

    def update_diagnostics(self) -> None:
        if hasattr(self, "_training"):
            progress = self._training.progress
            for name in ("updates", "version", "samples", "dropped_invalid", "dropped_gap", "dropped_stale"):
                self.diagnostics.gauge(name, getattr(progress, name))

    def _train_from_replay(self, uri: str) -> None:
        """Send this node's own action a goal, as soon as its server is there."""
        client = GuardedActionClient(self, Train, "train")
        self.own(client.destroy)
        goal = Train.Goal(updates=self._config.ppo.updates, from_replay=True, bag_uris=[uri])

        def send() -> None:
            if self.active and client.server_is_ready():
                timer.cancel()
                client.send_goal_async(goal)

        timer = self.create_timer(0.1, send, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.own(self.destroy_timer, timer)

    # Training, in a worker thread.

    def train(self, work: Work, result: Train.Result) -> None:
        goal: Train.Goal = work.request
        began, first_samples = time.monotonic(), self._training.progress.samples
        with closing(self._source(work, goal)) as source:
            for update in range(int(goal.updates)):
                work.check()
                result.message = self._meter.check(work.check)
                if result.message or self._over_limit(goal, began, first_samples):
                    result.termination_reason = Train.Result.LIMIT
                    return
                following = self._next(source, live=not goal.from_bags and not goal.from_replay)
                if following is None:
                    text = self._exhausted(goal, update, source.left_out)
                    if not update:
                        raise ValueError(text)
                    result.termination_reason, result.message = Train.Result.EXHAUSTED, text
                    return
                self._count_dropped(following[1])
                self._update(work, goal, update, *following)
                if 0 < self._config.ppo.converged_updates <= self._training.progress.unfailed:
                    result.termination_reason = Train.Result.LIMIT
                    result.message = f"converged: {self._training.progress.unfailed} updates without a failed episode"
                    return
            self._meter.check(work.check)

    def _next(
        self, source: RolloutSource, *, live: bool
    ) -> tuple[Rollout | TensorRollout, DroppedTransitions] | None:
        """The next rollout to train on. One whose episodes the agent could not judge pauses live training, which then
        repeats it; in a recording it is passed over. Raises as RolloutSource.next, check_horizon; TrainingPaused.
        """
        while (following := source.next()) is not None and self._reward_name == AGENT:
            check_horizon(self._config.ppo.num_steps, self._max_episode_steps)
            assert isinstance(following[0], Rollout)  # device rollouts have another reward
            if not (reason := unjudged_reason(following[0])):
                break
            if live:
                raise TrainingPaused(reason)
            source.left_out.append(reason)
        return following

    def _source(self, work: Work, goal: Train.Goal) -> RolloutSource:
        """Raises ValueError for a goal that asks for nothing, or for two sources."""
        if not goal.updates:
            raise ValueError("updates is 0; ask for at least 1")
        if goal.from_bags and goal.from_replay:
            raise ValueError("from_bags and from_replay are both set; choose one")
        progress, num_steps = self._training.progress, self._config.ppo.num_steps

        def check() -> None:
            work.check()
            if self._refused is not None:
                raise self._refused

        if goal.from_bags:
            paths = bag_paths(goal.bag_uris, self._files)
            self._reward_name = recorded_reward_name(paths[0])
            self._max_episode_steps = read_spec(paths[0]).max_episode_steps
            return BagRollouts(paths, progress, num_steps=num_steps, expected=self._expected_spec)
        if goal.from_replay:
            uris = [str(path) for path in bag_paths(goal.bag_uris, self._files)] if goal.bag_uris else []
            if uris:
                self._refused = None
            return ReplayedRollouts(self, check, progress, self._assembler, self._replay, uris, num_steps=num_steps)
        if self._device_rollouts is not None:
            self._reward_name = "endogenous"
            return self._device_rollouts.begin(check, self._training, self._config, str(self.param("model_dir")))
        return LiveRollouts(
            self, work, check, progress, self._assembler, self._rollouts, num_steps=num_steps, seed=self._config.seed
        )

    def _exhausted(self, goal: Train.Goal, made: int, left_out: list[str]) -> str:
        source = "the bags hold" if goal.from_bags else "the replay held"
        steps, version = self._config.ppo.num_steps, self._training.progress.version
        text = (
            f"{source} {made} rollouts of {steps} lock-steps (ppo.num_steps) by the versions that were trained, not "
            f"{goal.updates}; the next needed is of version {version}: start from the recorded run's first weights"
        )
        return text + (f"; left out: {first_few(left_out, 3)}" if left_out else "")

    def _count_dropped(self, dropped: DroppedTransitions) -> None:
        for key, number in (("invalid", dropped.invalid), ("gap", dropped.gap), ("stale", dropped.stale)):
            if number:
                self.diagnostics.count(f"dropped_{key}", number, text=f"{number} transitions dropped: {key}")

    def _over_limit(self, goal: Train.Goal, began: float, first_samples: int) -> bool:
        samples = self._training.progress.samples - first_samples
        minutes = (time.monotonic() - began) / 60
        return bool(goal.max_samples and samples >= goal.max_samples) or bool(
            goal.max_minutes and minutes >= goal.max_minutes
        )

    def _update(
        self, work: Work, goal: Train.Goal, update: int, rollout: Rollout | TensorRollout, dropped: DroppedTransitions
    ) -> None:
        began = time.perf_counter()
        try:
            metrics = self._training.update(
                rollout, dropped, lambda: work.stopped, paid_at_end=self._reward_name == AGENT
            )
        except FloatingPointError as error:
            self._report.nonfinite(self._training.progress, error)
            raise
        except Canceled:
            work.check()
            raise
        self.diagnostics.latency("update", time.perf_counter() - began)
        self.announce()
        samples_per_s = float(rollout.valid_TN.sum()) / max(time.perf_counter() - began, 1e-9)
        progress = self._training.progress
        self._report.updated(progress, metrics, samples_per_s)
        work.feedback(
            Train.Feedback(
                update=update + 1, samples=progress.samples, mean_return=progress.mean_return,
                success_rate=progress.success_rate, loss=metrics.get("loss_policy", float("nan")),
                samples_per_s=samples_per_s, policy_version=progress.version, progress=(update + 1) / goal.updates,
            )
        )

    def fill(self, result: Train.Result) -> Train.Result:
        progress = self._training.progress
        result.policy_version, result.updates, result.samples = progress.version, progress.updates, progress.samples
        result.mean_return, result.success_rate = progress.mean_return, progress.success_rate
        result.checkpoint_uri = self._training.checkpoint
        return result

    # Callbacks.

    def _withhold(self, withheld: bool) -> None:
        if self._credit is not None:
            self._credit.withhold(withheld)

    def _on_spec(self, message: EnvSpec) -> None:
        try:
            check_session(message.session)
            spec = convert.spec_from_msg(message)
        except WireError as error:
            self.diagnostics.count("refused_specs", level=diagnostics.ERROR, text=str(error))
            if self._spec is None:  # else the one before stays
                self._refused = error
            return
        try:
            self._spec, self._refused = spec, None
            if self._expected_spec is not None:
                refuse_other(self._spec, self._expected_spec, "the learner's policy needs")
            self._max_episode_steps = self._spec.max_episode_steps
            self._spec_session = message.session
            self._assembler.enter_session(message.session)
        except WireError as error:
            self._spec, self._refused = None, error
            self.diagnostics.count("refused_specs", level=diagnostics.ERROR, text=str(error))

    def _on_image(self, message: Image) -> None:
        if self._spec is not None and self._assembler.collecting:
            self._assembler.put_image(time_ns(message.header.stamp), images_of(message, self._spec))

    def _on_transition(self, message: TransitionBatch) -> None:
        if self._spec is not None and self._assembler.collecting:
            check_session(message.session, self._spec_session)
            self._assembler.put_transition(convert.transition_of(message, self._spec))

    def _on_reward(self, message: RewardBatch) -> None:
        if self._assembler.collecting:
            self._assembler.put_rewards(convert.rewards_of(message))
            self._reward_name = message.reward_name

    def _on_save(self, request: SaveCheckpoint.Request, response: SaveCheckpoint.Response) -> SaveCheckpoint.Response:
        if self.training:
            raise WireError(ErrorCode.BUSY, "training is running and saves after every update; cancel it or wait")
        try:
            path = self._files.new(request.uri, "checkpoints") if request.uri else (
                self.run_dir / self._training.checkpoint
            )
            self._training.save_checkpoint(path)
        except OSError as error:
            self.diagnostics.count("failed_saves", level=diagnostics.ERROR, text=f"checkpoint not written: {error}")
            return convert.fill_error(response, WireError(ErrorCode.IO_ERROR, f"checkpoint not written: {error}"))
        response.uri, response.version = str(path), self._training.progress.version
        return response

    def _on_get_weights(self, request: GetWeights.Request, response: GetWeights.Response) -> GetWeights.Response:
        if not 0 < request.max_bytes <= MAX_CHUNK_BYTES:
            raise WireError(
                ErrorCode.OUT_OF_RANGE, f"max_bytes must lie in 1..{MAX_CHUNK_BYTES}, got {request.max_bytes}"
            )
        version = request.version or self._training.saved_version
        try:
            data = self._training.weights_of(version).data
        except OSError:
            text = f"policy version {request.version} is not in {self.run_dir / 'policies'}; ask for 0, the newest"
            raise WireError(ErrorCode.NOT_FOUND, text) from None
        if request.offset >= len(data):
            raise WireError(
                ErrorCode.OUT_OF_RANGE,
                f"offset {request.offset} lies behind the end of {len(data)} bytes; begin again at 0",
            )
        chunk = data[request.offset : request.offset + request.max_bytes]
        response.version, response.total, response.crc32 = version, len(data), zlib.crc32(chunk)
        response.data = convert.bytes_field(chunk)
        return response


def make_run(values: Mapping[str, Any], run_dir: Path, ranks: Ranks) -> PolicyTraining:
    """The run that a node's parameters describe."""
    config = with_reader(load_config(str(values["config_file"])), Path(str(values["model_dir"])))
    config = config.with_values(device=str(own_device(config.device)))
    policy = make_policy(config, str(values["model_dir"]))
    load_initial(policy, str(values["initial_policy"]))
    learner = make_learner(policy, config, ranks)
    return PolicyTraining(
        policy, learner, run_dir, resume=bool(values["resume"]), keep_versions=int(values["keep_versions"]),
        metadata={"tokenizer_sha256": policy.encoder.sha256}, ranks=ranks,
    )


def main() -> int:
    """One process, or under torchrun rank 0 as the node and the other ranks behind it; return the exit code."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return run_node(LearnerNode)
    values = read_parameters("learner", (*COMMON, *PARAMS))
    ranks = join(load_config(str(values["config_file"])).device)
    if ranks.rank == 0:
        return run_node(lambda: LearnerNode(ranks))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # rank 0 ends the others
    make_run(values, Path(str(values["run_dir"])), ranks).follow()
    return 0


if __name__ == "__main__":
    sys.exit(main())
